"""OpenPose's BODY_25, the only set of keypoints that is used after ingestion."""

from enum import IntEnum


class Body25(IntEnum):
    """The rows of a person's keypoints (25, 3), in OpenPose's order. R and L: the person's own right and left."""

    NOSE = 0
    NECK = 1
    R_SHOULDER = 2
    R_ELBOW = 3
    R_WRIST = 4
    L_SHOULDER = 5
    L_ELBOW = 6
    L_WRIST = 7
    MID_HIP = 8
    R_HIP = 9
    R_KNEE = 10
    R_ANKLE = 11
    L_HIP = 12
    L_KNEE = 13
    L_ANKLE = 14
    R_EYE = 15
    L_EYE = 16
    R_EAR = 17
    L_EAR = 18
    L_BIG_TOE = 19
    L_SMALL_TOE = 20
    L_HEEL = 21
    R_BIG_TOE = 22
    R_SMALL_TOE = 23
    R_HEEL = 24


RIGHT_ARM = ((Body25.R_SHOULDER, Body25.R_ELBOW), (Body25.R_ELBOW, Body25.R_WRIST))
LEFT_ARM = ((Body25.L_SHOULDER, Body25.L_ELBOW), (Body25.L_ELBOW, Body25.L_WRIST))
RIGHT_LEG = ((Body25.R_HIP, Body25.R_KNEE), (Body25.R_KNEE, Body25.R_ANKLE))
LEFT_LEG = ((Body25.L_HIP, Body25.L_KNEE), (Body25.L_KNEE, Body25.L_ANKLE))
# Lines between keypoints that are drawn as a person.
LIMBS = (
    (Body25.NECK, Body25.R_SHOULDER), *RIGHT_ARM, (Body25.NECK, Body25.L_SHOULDER), *LEFT_ARM,
    (Body25.MID_HIP, Body25.R_HIP), *RIGHT_LEG, (Body25.MID_HIP, Body25.L_HIP), *LEFT_LEG,
    (Body25.NECK, Body25.MID_HIP), (Body25.NOSE, Body25.NECK),
)  # fmt: skip
FEET = (
    (Body25.R_ANKLE, Body25.R_HEEL), (Body25.R_ANKLE, Body25.R_BIG_TOE),
    (Body25.L_ANKLE, Body25.L_HEEL), (Body25.L_ANKLE, Body25.L_BIG_TOE),
)  # fmt: skip
# Big toe, small toe and heel, below each ankle.
LEFT_FOOT = (Body25.L_BIG_TOE, Body25.L_SMALL_TOE, Body25.L_HEEL)
RIGHT_FOOT = (Body25.R_BIG_TOE, Body25.R_SMALL_TOE, Body25.R_HEEL)
EARS = (Body25.R_EAR, Body25.L_EAR)
ANKLES = (Body25.R_ANKLE, Body25.L_ANKLE)
