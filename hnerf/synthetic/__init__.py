"""A synthetic performer: a clothed person walks in a room before calibrated cameras; with exact ground truth."""

from hnerf.synthetic.write import write_synthetic_capture

__all__ = ["write_synthetic_capture"]
