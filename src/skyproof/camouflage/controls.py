"""The controls beside an attack: camouflages under its constraints that no gradient optimised."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from skyproof.camouflage.constraints import TextureConstraints
from skyproof.camouflage.name import CamouflageName


@dataclass(frozen=True)
class Controls:
    """The names of an attack's controls.

    Attributes:
        random: random draws; "R-PixMa" for "T-PixMa".
        plain_paint: the best plain paint under the same mask; "R-Ma_plain".
        best_of_n: the best of many random draws; "R-PixMa_best".
        search: the result of a random search; "R-PixMa_search".
        random_shape: a random shape on the attack's own texture; "R-C-Fc-seq@0.2" for
            "C-Fc-seq@0.2", None unless the attack is a combination.
    """

    random: CamouflageName
    plain_paint: CamouflageName
    best_of_n: CamouflageName
    search: CamouflageName
    random_shape: CamouflageName | None

    @property
    def chosen(self) -> tuple[CamouflageName, CamouflageName, CamouflageName]:
        """The controls that are chosen on other scenes: plain paint, best of N, search."""
        return self.plain_paint, self.best_of_n, self.search


def controls(attack: CamouflageName) -> Controls:
    """Names the controls that go with an attack."""
    random = attack.control
    plain = random
    if plain.constraints is not None:
        plain = replace(plain, constraints=TextureConstraints(masked=plain.constraints.masked))
    combined = attack.order is not None and not attack.random
    return Controls(
        random,
        plain.with_variant("plain"),
        random.with_variant("best"),
        random.with_variant("search"),
        replace(attack.base, random=True) if combined else None,
    )


def chosen_controls(attacks: Mapping[CamouflageName, int]) -> dict[CamouflageName, int]:
    """Gives every chosen control of some attacks the steps of the longest attack beside it."""
    steps: dict[CamouflageName, int] = {}
    for name, count in attacks.items():
        for control in controls(name).chosen:
            steps[control] = max(count, steps.get(control, 0))
    return steps
