"""Prefect tasks, one for each stage, and what they share: artifact store, cache policy, launcher of several processes.

Stages are called capture, detection, calibration, segmentation, fit, training, evaluation and asset throughout. An
artifact passed on from a stage has the stage's name, except that `recording` is that of capture or detection and `body`
that of fit.
"""

import logging

logging.getLogger("hnerf").setLevel(logging.INFO)  # Prefect forwards what the library's loggers pass
