"""The capability in checkmaite, where that is installed: it asks for a MAITE below 0.10."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("checkmaite", reason="needs checkmaite, in an environment of its own")

from skyproof.maite import DetectorModel, VehicleDataset
from tests.maite.conftest import Folders


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is read from what other programs have left."""
    from checkmaite.core import capability_core

    monkeypatch.setattr(capability_core, "cache_path", lambda: tmp_path)


def test_checkmaite_offers_and_runs_the_capability(folders: Folders, model: DetectorModel) -> None:
    import checkmaite.core.object_detection as offered
    from checkmaite.core._plugins import list_loaded_plugins

    (record,) = (each for each in list_loaded_plugins() if each.package_name == "skyproof")
    assert record.error is None
    assert record.status == "loaded"
    capability = offered.SkyproofCamouflage()
    original = VehicleDataset(folders.original)
    camouflaged = VehicleDataset(folders.camouflaged)
    run = capability.run(models=[model], datasets=[original, camouflaged])
    (name,) = run.outputs.hidden
    assert name == camouflaged.metadata["id"]
    assert run.outputs.hidden[name]["found_before"] > 4
    stored = capability.run(models=[model], datasets=[original, camouflaged])
    assert stored.outputs == run.outputs
    page = run.collect_md_report(0.8).content
    assert name in page
    assert "95 % interval" in page
    with pytest.raises(TypeError, match="got one dataset alone"):
        capability.run(models=[model], datasets=[original])
