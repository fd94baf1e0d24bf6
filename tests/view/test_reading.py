"""Any file of Gaussians is read, and checkpoints with the antialiasing of their run."""

import pytest
import torch

from tests.helpers.pruning import ball
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.view.reading import read_any


def checkpoint(folder):
    cloud = ball(20)
    names = {"sh0": cloud.sh, "sh_rest": torch.zeros(20, 0, 3)}
    names |= {name: value for name, value in cloud._asdict().items() if name != "sh"}
    folder.mkdir(parents=True)
    state = {f"geometry.{name}": value for name, value in names.items()}
    torch.save({"state_dict": state}, folder / "last.ckpt")
    return folder / "last.ckpt"


@pytest.mark.parametrize("option", ["true", "false", "1", "{}"])
def test_a_checkpoint_has_the_antialiasing_of_its_run(tmp_path, option):
    path = checkpoint(tmp_path / "run/ckpts")
    (tmp_path / "run/configs").mkdir()
    parsed = tmp_path / "run/configs/parsed.yaml"
    parsed.write_text(f"system: {{renderer: {{antialias: {option}}}}}")
    assert read_any(path).antialiased == (option == "true")
    assert not read_any(checkpoint(tmp_path / "alone")).antialiased


def test_files_are_read_by_their_extension(tmp_path):
    write_cloud(str(tmp_path / "a.spz"), StoredCloud(ball(20).arrays(), antialiased=True))
    assert read_any(tmp_path / "a.spz", "y").antialiased
    with pytest.raises(UserError, match="IN"):
        read_any(tmp_path / "a.png", option="IN")
