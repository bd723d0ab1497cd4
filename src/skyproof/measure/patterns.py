"""What a score folder keeps of how camouflages look, and of what it takes to make them."""

from collections.abc import Mapping
from pathlib import Path

from PIL import Image

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.practicality import practicality_account
from skyproof.files import inside, write_beside, write_bytes, write_json
from skyproof.render.portrait import portrait
from skyproof.results.score_folder import is_pictured
from skyproof.vehicles.fleet import Fleet


def add_patterns(folder: Path, worn: Mapping[Path, Camouflage], fleet: Fleet) -> None:
    """Adds what the pictured camouflages look like, and what they ask of their makers."""
    vehicles = fleet.batch(fleet.ids)
    rows = []
    for place, camouflage in worn.items():
        if not is_pictured(CamouflageName.read(place.name)):
            continue
        own = folder / "patterns" / place.name
        picture = portrait(fleet, camouflage.cpu())
        with write_beside(own / "on_vehicle.png") as temporary:
            Image.fromarray(picture.permute(1, 2, 0).numpy()).save(temporary)
        for file in ("texture.png", "steps.jsonl"):
            if (place / file).exists():
                write_bytes(own / file, inside(place, file, place).read_bytes())
        rows.append({**practicality_account(camouflage, vehicles), "name": place.name})
    if rows:
        write_json(folder / "practicality.json", {"vehicles": len(vehicles), "rows": rows})
