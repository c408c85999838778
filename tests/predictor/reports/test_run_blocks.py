import json
from pathlib import Path

from predictor.reports.document import Paragraph
from predictor.reports.run_blocks import ACCURACY_FILE, accuracy

LINE = {"name": "dG-VAE", "num_samples": 1, "agents": 3, "min_ade_m": 0.5}


def test_a_table_is_named_with_the_environments_arguments(tmp_path: Path):
    """Two folders of one id, one of them with other traffic, are not the same table."""
    folders = []
    for name, arguments in (("stock", ""), ("dense", '{"config": {"vehicles_density": 2}}')):
        folders.append(tmp_path / name)
        folders[-1].mkdir()
        result = {"env_id": "road-v0", "env_kwargs": arguments, "driver": "idle", "model": LINE, "model_samples": LINE}
        content = {"results": [result | {"constant_velocity": LINE, "controls": {}}]}
        (folders[-1] / ACCURACY_FILE).write_text(json.dumps(content))
    said = [block.text for block in accuracy(folders) if isinstance(block, Paragraph)]
    assert "road-v0, driven idle:" in said
    assert 'road-v0 {"config": {"vehicles_density": 2}}, driven idle:' in said
