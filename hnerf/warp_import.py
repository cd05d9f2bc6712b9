"""warp, imported without its banner and its warnings. Every module imports it from here."""

import warp as wp

__all__ = ["wp"]

wp.config.log_level = wp.LOG_ERROR
# Derivatives are kernels of their own; without automatic ones, kernels compile in half the time.
wp.config.enable_backward = False
