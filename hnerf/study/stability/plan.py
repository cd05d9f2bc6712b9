"""What a stability study tries: a YAML file under `configs/stability/`."""

from collections.abc import Collection
from typing import Annotated

from pydantic import Field, NonNegativeInt

from hnerf.config import CONFIGS, Section, named_file, read_yaml, validated
from hnerf.errors import InputError
from hnerf.study.benchmark.plan import Part
from hnerf.study.degradations.catalogue import KINDS, check_strengths

STUDIES = CONFIGS / "stability"
FULL = "full"


class Stability(Section):
    """Presets, seeds of degradations and training, settings changed in all runs, and each degradation's strengths, the
    mildest first. border_seeds: further seeds, of what is near the border of two verdicts by those before; part: of the
    capture that stands for all of it."""

    methods: Annotated[tuple[str, ...], Field(min_length=1)]
    seeds: Annotated[tuple[NonNegativeInt, ...], Field(min_length=1)]
    border_seeds: tuple[NonNegativeInt, ...] = ()
    part: Part = Part()
    overrides: tuple[str, ...] = ()
    degradations: Annotated[dict[str, tuple[float, ...]], Field(min_length=1)]

    def only(self, names: Collection[str]) -> "Stability":
        """The study of these degradations only, of all where there are no names; InputError for one it has not."""
        for name in names:
            if name not in self.degradations:
                raise InputError(f"--only {name}: not in this study; it has {', '.join(self.degradations)}")
        chosen = {name: values for name, values in self.degradations.items() if not names or name in names}
        return self.model_copy(update={"degradations": chosen})

    def left_out(self) -> list[str]:
        """What it does not try, in lines for people, against `configs/stability/full.yaml`."""
        full = load_stability(FULL)
        lines = [f"`{name}` as a method" for name in full.methods if name not in self.methods]
        seeds = len(full.seeds) - len(self.seeds)
        but = ", but where a verdict is near its border" if self.border_seeds else ": no spread is known from so few"
        lines += [f"{seeds} of {len(full.seeds)} seeds{but}"] if seeds > 0 else []
        if self.part != Part():
            kept = self.part.model_dump(exclude_defaults=True).items()
            lines.append(f"the capture beyond a part of it: {', '.join(f'{key} {value}' for key, value in kept)}")
        lines += [f"what the preset says: `{override}` instead" for override in self.overrides]
        for name, strengths in full.degradations.items():
            missing = [f"{s:g}" for s in strengths if s not in self.degradations.get(name, ())]
            if missing:
                lines.append(f"{KINDS[name].label}: {', '.join(missing)}")
        return lines


def load_stability(study: str) -> Stability:
    """A study by its name under `configs/stability/` or its file's path; InputError, one line, on what is wrong."""
    path = named_file(study, STUDIES, "study", "studies")
    found = validated(Stability, read_yaml(path), path)
    for kind, strengths in found.degradations.items():
        try:
            check_strengths(kind, strengths)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    return found
