"""How practical a camouflage is, in the paper's three signs, as its constraints say (section 4)."""

from dataclasses import dataclass

from skyproof.camouflage.constraints import TextureConstraints


@dataclass(frozen=True)
class Signs:
    """One sign per criterion: +1 for practical, 0 for neither, −1 for impractical.

    Attributes:
        production_cost: PC, cost of material and labour.
        installation_difficulty: DI, difficulty of putting it onto a vehicle.
        operation_difficulty: DO, hindrance in driving.
    """

    production_cost: int
    installation_difficulty: int
    operation_difficulty: int

    @property
    def total(self) -> int:
        """Sum of the three, −3 to 3."""
        return self.production_cost + self.installation_difficulty + self.operation_difficulty


@dataclass(frozen=True)
class PracticalityScore:
    """The signs of texture and shape, apart; 0 for an original side."""

    texture: Signs
    shape: Signs

    @property
    def total(self) -> int:
        """Sum of all six signs, −6 to 3."""
        return self.texture.total + self.shape.total


_NO_CHANGE = Signs(0, 0, 0)


def score_practicality(
    texture: TextureConstraints | None, shape_changed: bool
) -> PracticalityScore:
    """The paper's rules (section 4).

    - Installation is + with Pix, as blocks can be stuck on or painted one by one, otherwise −.
    - Operation is + with Ma, as windows, lights and wheels stay free, otherwise −.
    - Production is + with Pix and Fc, 0 with Pix and Lc (its colours may be hard to get), otherwise
      −: few colours alone save nothing, because the whole vehicle still has to be wrapped.
    - A changed shape is − in all three.
    """
    shape = Signs(-1, -1, -1) if shape_changed else _NO_CHANGE
    if texture is None:
        return PracticalityScore(_NO_CHANGE, shape)
    production = {"fixed": 1, "learnt": 0, "free": -1}[texture.colours] if texture.pixelised else -1
    signs = Signs(production, 1 if texture.pixelised else -1, 1 if texture.masked else -1)
    return PracticalityScore(signs, shape)
