"""warp, imported without its banner and its warnings. Every module imports it from here."""

import torch
import warp as wp

__all__ = ["refuse_second_derivatives", "wp"]

wp.config.log_level = wp.LOG_ERROR
# Derivatives are kernels of their own; without automatic ones, kernels compile in half the time.
wp.config.enable_backward = False


def refuse_second_derivatives() -> None:
    """Raise RuntimeError in the backward pass of a kernel if that pass is to be differentiated in turn: torch would
    take its result for a constant, without a word."""
    if torch.is_grad_enabled():
        raise RuntimeError("kernels of warp have no second derivatives here; use finite differences")
