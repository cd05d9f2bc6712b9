"""One Prefect task a stage, and what they share: artifact store, cache policy, launcher of several processes."""

import logging

logging.getLogger("hnerf").setLevel(logging.INFO)  # Prefect passes on what the library's loggers let through
