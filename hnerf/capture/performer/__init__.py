"""A synthetic performer: a clothed person walks in a room before calibrated cameras; with exact ground truth."""

from hnerf.capture.performer.write import write_performer
from hnerf.config import PerformerSettings

__all__ = ["PerformerSettings", "write_performer"]
