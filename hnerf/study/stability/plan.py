"""Plan of a stability study, read from a YAML file under `configs/stability/`."""

from collections.abc import Collection
from typing import Annotated

from pydantic import Field

from hnerf.config import CONFIGS, Section, Seed, named_file, read_yaml, validated
from hnerf.errors import InputError
from hnerf.study.benchmark.plan import CapturePart
from hnerf.study.degradations.catalogue import KINDS, check_strengths

STUDIES = CONFIGS / "stability"
FULL = "full"


class StabilityStudy(Section):
    """A stability study: presets, seeds of degradations and training, settings overridden in all runs, and each
    degradation's strengths, the mildest first. border_seeds: further seeds for degradations whose verdict with the
    other seeds is near a border; part: the part of the capture that is used."""

    methods: Annotated[tuple[str, ...], Field(min_length=1)]
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)]
    border_seeds: tuple[Seed, ...] = ()
    part: CapturePart = CapturePart()
    overrides: tuple[str, ...] = ()
    degradations: Annotated[dict[str, tuple[float, ...]], Field(min_length=1)]

    def restricted_to(self, names: Collection[str]) -> "StabilityStudy":
        """Return the study with these degradations only, or with all if there are no names. Raises InputError if the
        study does not have one of them."""
        for name in names:
            if name not in self.degradations:
                raise InputError(f"--only {name}: not in this study; it has {', '.join(self.degradations)}")
        chosen = {name: values for name, values in self.degradations.items() if not names or name in names}
        return self.model_copy(update={"degradations": chosen})

    def left_out(self) -> list[str]:
        """Return what the study omits compared with `configs/stability/full.yaml`, as lines for people."""
        full = load_stability(FULL)
        lines = [f"`{name}` as a method" for name in full.methods if name not in self.methods]
        seeds = len(full.seeds) - len(self.seeds)
        but = ", except where a verdict is near a border" if self.border_seeds else ": too few to know the variance"
        lines += [f"{seeds} of {len(full.seeds)} seeds{but}"] if seeds > 0 else []
        if self.part != CapturePart():
            kept = self.part.model_dump(exclude_defaults=True).items()
            lines.append(f"the capture outside this part: {', '.join(f'{key} {value}' for key, value in kept)}")
        lines += [f"the preset's own value: `{override}` instead" for override in self.overrides]
        for name, strengths in full.degradations.items():
            missing = [f"{s:g}" for s in strengths if s not in self.degradations.get(name, ())]
            if missing:
                lines.append(f"{KINDS[name].label}: {', '.join(missing)}")
        return lines


def load_stability(study: str) -> StabilityStudy:
    """Load a study by its name under `configs/stability/` or its file's path. Raises InputError, in one line, if it is
    invalid."""
    path = named_file(study, STUDIES, "study")
    found = validated(StabilityStudy, read_yaml(path), path)
    for kind, strengths in found.degradations.items():
        try:
            check_strengths(kind, strengths)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    return found
