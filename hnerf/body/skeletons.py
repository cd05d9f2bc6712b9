"""Joint names of exported skeletons, and the names of the same joints in other skeletons.

Exported names are those common in the field, with `_L` and `_R` so that Blender can mirror them. Other skeletons:
Unreal Engine 5 (Manny), Mixamo (its prefix "mixamorig:" left out), HumanIK (Maya, MotionBuilder), VRM 1.0 humanoid,
SMPL-X (joint names of its package), and those of recordings in BVH files: CMU's motion capture database, Biovision
(as Xsens writes it), and SMPL.
"""

import re
from typing import Literal, NamedTuple

ROOT, PELVIS = "root", "pelvis"
JointNames = Literal["own", "ue5", "mixamo", "humanik", "vrm", "smplx"]  # after whose joints exports name theirs
OWN: JointNames = "own"

# Names of the body models' joints (hnerf/body/anny.py, hnerf/body/smpl.py), without side, where exports rename them.
_RENAMED = {
    "root": PELVIS, "pelvis": "hip", "upperleg01": "thigh", "upperleg02": "thigh_twist", "lowerleg01": "calf",
    "lowerleg02": "calf_twist", "spine05": "spine_01", "spine04": "spine_02", "spine03": "spine_03",
    "spine02": "spine_04", "spine01": "spine_05", "neck01": "neck_01", "neck02": "neck_02", "neck03": "neck_03",
    "shoulder01": "shoulder", "upperarm01": "upperarm", "upperarm02": "upperarm_twist", "lowerarm01": "forearm",
    "lowerarm02": "forearm_twist", "wrist": "hand", "hand": "hand_end", "toes": "middle_toe_01",
}  # fmt: skip
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_TOES = ("big_toe", "second_toe", "middle_toe", "fourth_toe", "little_toe")
_RENAMED |= {f"finger{k}-{s}": f"{name}_0{s}" for k, name in enumerate(FINGERS, 1) for s in (1, 2, 3)}
_RENAMED |= {f"metacarpal{k}": f"{name}_metacarpal" for k, name in enumerate(FINGERS[1:], 1)}
_RENAMED |= {f"toe{k}-{s}": f"{name}_0{s}" for k, name in enumerate(_TOES, 1) for s in (1, 2, 3)}

# Joints in series with another, and toes other than the middle one: the game skeleton omits these.
_SERIAL = re.compile(
    r"(hip|thigh_twist|calf_twist|spine_02|spine_04|shoulder|upperarm_twist|forearm_twist|neck_02|neck_03"
    r"|\w+_metacarpal|(big|second|fourth|little)_toe_0\d|middle_toe_0[23])(_[LR])?"
)


class Names(NamedTuple):
    """One joint's names in other skeletons; empty where a skeleton has no such joint."""

    ue5: str = ""
    mixamo: str = ""
    humanik: str = ""
    vrm: str = ""
    smplx: str = ""
    cmu: str = ""
    biovision: str = ""
    smpl: str = ""


SKELETONS = Names._fields
PREFIXES = {"mixamo": "mixamorig:"}  # of names in Mixamo's own files; names in USD have no colon


def exported_name(joint: str) -> str:
    """Return the name that a body model's joint has in exported skeletons, like upperarm_L for upperarm01.L."""
    name, dot, side = joint.partition(".")
    return f"{_RENAMED.get(name, name)}{'_' if dot else ''}{side}"


def is_serial(joint: str) -> bool:
    """Return whether the game skeleton omits this exported joint."""
    return _SERIAL.fullmatch(joint) is not None


def _sided() -> dict[str, Names]:
    """Return the names of the joints that come in pairs, with {Side}, {side}, {S} and {s} in place of Left, left, L and
    l."""
    one = {
        "clavicle": Names("clavicle_{s}", "{Side}Shoulder", "{Side}Shoulder", "{side}Shoulder", "{side}_collar",
                          "{Side}Shoulder", "{Side}Collar", "{S}_Collar"),
        "upperarm": Names("upperarm_{s}", "{Side}Arm", "{Side}Arm", "{side}UpperArm", "{side}_shoulder",
                          "{Side}Arm", "{Side}Shoulder", "{S}_Shoulder"),
        "upperarm_twist": Names("upperarm_twist_01_{s}", "", "Leaf{Side}ArmRoll1"),
        "forearm": Names("lowerarm_{s}", "{Side}ForeArm", "{Side}ForeArm", "{side}LowerArm", "{side}_elbow",
                         "{Side}ForeArm", "{Side}Elbow", "{S}_Elbow"),
        "forearm_twist": Names("lowerarm_twist_01_{s}", "", "Leaf{Side}ForeArmRoll1"),
        "hand": Names("hand_{s}", "{Side}Hand", "{Side}Hand", "{side}Hand", "{side}_wrist",
                      "{Side}Hand", "{Side}Wrist", "{S}_Wrist"),
        "thigh": Names("thigh_{s}", "{Side}UpLeg", "{Side}UpLeg", "{side}UpperLeg", "{side}_hip",
                       "{Side}UpLeg", "{Side}Hip", "{S}_Hip"),
        "thigh_twist": Names("thigh_twist_01_{s}", "", "Leaf{Side}UpLegRoll1"),
        "calf": Names("calf_{s}", "{Side}Leg", "{Side}Leg", "{side}LowerLeg", "{side}_knee",
                      "{Side}Leg", "{Side}Knee", "{S}_Knee"),
        "calf_twist": Names("calf_twist_01_{s}", "", "Leaf{Side}LegRoll1"),
        "foot": Names("foot_{s}", "{Side}Foot", "{Side}Foot", "{side}Foot", "{side}_ankle",
                      "{Side}Foot", "{Side}Ankle", "{S}_Ankle"),
        "middle_toe_01": Names("ball_{s}", "{Side}ToeBase", "{Side}ToeBase", "{side}Toes", "{side}_foot",
                               "{Side}ToeBase", "{Side}Toe", "{S}_Foot"),
        "eye": Names(vrm="{side}Eye", smplx="{side}_eye_smplhf"),
    }  # fmt: skip
    for finger in FINGERS:
        segments = ("Metacarpal", "Proximal", "Distal") if finger == "thumb" else ("Proximal", "Intermediate", "Distal")
        vrm, title = "Little" if finger == "pinky" else finger.capitalize(), finger.capitalize()
        for k, segment in enumerate(segments, 1):
            hand = f"{{Side}}Hand{title}{k}"
            one[f"{finger}_0{k}"] = Names(
                f"{finger}_0{k}_{{s}}", hand, hand, f"{{side}}{vrm}{segment}", f"{{side}}_{finger}{k}"
            )
        if finger != "thumb":
            one[f"{finger}_metacarpal"] = Names(f"{finger}_metacarpal_{{s}}", "", f"{{Side}}InHand{title}")
    return one


def _of_side(names: Names, side: str) -> Names:
    words = {"Side": side, "side": side.lower(), "S": side[0], "s": side[0].lower()}
    return Names(*(name.format(**words) for name in names))


# By exported name.
EQUIVALENTS: dict[str, Names] = {
    ROOT: Names("root", "", "Reference"),
    PELVIS: Names("pelvis", "Hips", "Hips", "hips", "pelvis", "Hips", "Hips", "Pelvis"),
    "spine_01": Names("spine_01", "Spine", "Spine", "spine", "spine1", "LowerBack", "Chest", "Spine1"),
    "spine_02": Names("spine_02"),
    "spine_03": Names("spine_03", "Spine1", "Spine1", "chest", "spine2", "Spine", "Chest2", "Spine2"),
    "spine_04": Names("spine_04"),
    "spine_05": Names("spine_05", "Spine2", "Spine2", "upperChest", "spine3", "Spine1", "Chest4", "Spine3"),
    "neck_01": Names("neck_01", "Neck", "Neck", "neck", "neck", "Neck1", "Neck", "Neck"),
    "neck_02": Names("neck_02", "", "Neck1"),
    "head": Names("head", "Head", "Head", "head", "head", "Head", "Head", "Head"),
    **{f"{joint}_{side[0]}": _of_side(names, side) for side in ("Left", "Right") for joint, names in _sided().items()},
}


def name_in(skeleton: str, joint: str, prefixed: bool = False) -> str:
    """Return the name of an exported joint in another skeleton, one of SKELETONS, with that skeleton's prefix if
    `prefixed`; its exported name if that skeleton has no such joint, or is OWN."""
    theirs = getattr(EQUIVALENTS.get(joint), skeleton, "")
    return PREFIXES.get(skeleton, "") * prefixed + theirs if theirs else joint


def exported_from(skeleton: str) -> dict[str, str]:
    """Return a mapping from the names of another skeleton, one of SKELETONS, to exported names."""
    named = {getattr(names, skeleton): joint for joint, names in EQUIVALENTS.items()}
    return {theirs: ours for theirs, ours in named.items() if theirs}
