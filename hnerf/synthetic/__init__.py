"""A synthetic capture with exact ground truth: a clothed person walks in a room in front of calibrated cameras."""

from hnerf.synthetic.write import write_synthetic_capture

__all__ = ["write_synthetic_capture"]
