"""Prefect tasks, one for each stage, and what they share: artifact store, cache policy, launcher of several processes.

Stages are called cameras, capture, detection, hands, calibration, segmentation, fit, training, evaluation and asset
throughout. An artifact that is passed on from a stage has the stage's name, except that `recording` comes from capture,
detection or hands, and `body` from fit.
"""

import logging

logging.getLogger("hnerf").setLevel(logging.INFO)  # Prefect forwards the library's log records
