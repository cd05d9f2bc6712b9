"""Keypoints, a soft mask and metric landmarks of people, found in a recording's own images by a network."""
