"""A synthetic performer: a clothed person walks in a room before calibrated cameras; with exact ground truth."""

from hnerf.synthetic.write import write_performer

__all__ = ["write_performer"]
