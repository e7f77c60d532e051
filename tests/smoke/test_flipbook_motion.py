"""Motion between a flip book's frames: interpolated pictures, the texture, and mip levels."""

import numpy as np
import pytest
import torch
from PIL import Image
from reference.flipbook import between
from typer.testing import CliRunner

from benchmarks.smoke_learning import psnr
from wlm import smoke
from wlm.cli.smoke import app
from wlm.errors import WlmError
from wlm.smoke.flipbook.book import lay_out
from wlm.smoke.flipbook.motion import (
    ZERO,
    encoded,
    frames_motion,
    mip_levels,
    mip_padding,
    open_motion,
    scale_of,
)
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.motion import read_velocity, velocity_file
from wlm.smoke.scene import load_scene
from wlm.smoke.simulation import simulate

FRAMES = 26


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small explosion with the velocities of its air."""
    scene = load_scene("explosion").scaled(0.1).model_copy(update={"frames": FRAMES})
    frames = smoke.open_frames(tmp_path_factory.mktemp("smoke") / "explosion", scene)
    simulate(frames, velocity=True)
    return frames.path


def baked(folder, numbers, pixels: int = 96) -> list[SixWay]:
    frames = smoke.load_frames(folder)
    made = []
    for number in numbers:
        volume = frames.load(number)
        camera = frames.view(frames.camera.model_copy(update={"resolution": pixels}), volume)
        made.append(smoke.bake(volume, camera, step=1.0, estimate=False))
    return made


def test_between_two_frames_it_is_nearer_than_a_cross_fade(folder):
    """Halfway between frames motion gains 3 dB; at the frames nothing changes."""
    numbers = (18, 22, 26)
    book, middle = baked(folder, numbers), baked(folder, (20, 24))
    moved = frames_motion(open_motion(folder), numbers, book)
    assert moved.shape == (3, 2, 96, 96) and 0.01 < scale_of(moved) < 0.3
    # A texture of 8 bits is what engines have.
    scale = scale_of(moved)
    cells = np.round(encoded(moved, scale) * 255.0) / 255.0
    stored = torch.from_numpy((cells[..., :2] - ZERO) * 2.0 * scale * [1.0, -1.0]).permute(0, 3, 1, 2).float()
    assert float((stored - moved).abs().max()) < 1.1 * scale / 255.0
    for n, wanted in enumerate(middle):
        one, other = book[n : n + 2]
        for field in ("lightmaps", "transparency"):
            truth = getattr(wanted, field)
            fade = 0.5 * (getattr(one, field) + getattr(other, field))
            assert psnr(getattr(between(one, other, stored[n], 0.5), field), truth) > psnr(fade, truth) + 3.0
        for share, end in ((0.0, one), (1.0, other)):
            shown = between(one, other, torch.zeros_like(moved[n]), share)
            assert torch.allclose(shown.lightmaps, end.lightmaps, atol=1e-5)
            assert torch.allclose(shown.transparency, end.transparency, atol=1e-5)


def test_smoke_that_moves_as_a_whole_is_found_where_it_is():
    """A blot that moves to the right and up is in the middle halfway."""
    y, x = (np.mgrid[:32, :32] + 0.5) / 32

    def blot(right: float, down: float) -> SixWay:
        plane = torch.from_numpy(np.exp(-(((x - right) ** 2 + (y - down) ** 2) / 0.01))).float()
        return SixWay(plane.repeat(6, 1, 1), 1.0 - plane)

    way = torch.tensor([0.25, -0.125])[:, None, None].expand(2, 32, 32)
    one, other, middle = (blot(0.375 + 0.25 * share, 0.5625 - 0.125 * share) for share in (0.0, 1.0, 0.5))
    assert psnr(between(one, other, way, 0.5).lightmaps, middle.lightmaps) > 45.0
    assert psnr(0.5 * (one.lightmaps + other.lightmaps), middle.lightmaps) < 25.0


def test_zero_is_exact_in_eight_bits():
    still = encoded(torch.zeros(1, 2, 3, 3), 0.1)
    assert (np.round(still[..., :2] * 255) == 127).all() and not still[..., 2].any()
    right_up = encoded(torch.tensor([0.1, -0.1])[:, None, None].expand(2, 3, 3)[None], 0.1)
    assert right_up[..., :2] == pytest.approx(ZERO + 0.5)


@pytest.mark.parametrize(("height", "width", "levels"), [(24, 40, 3), (16, 16, 1), (50, 30, 2)])
def test_smaller_textures_show_no_neighbours(height: int, width: int, levels: int):
    """Mip levels within a frame do not depend on the neighbouring frames."""
    padding = mip_padding(height, width, levels)
    assert mip_levels(height, width, padding) >= levels
    random = np.random.default_rng(3)
    frame = random.random((height, width, 1), np.float32)

    def shown(neighbours: float, level: int) -> torch.Tensor:
        cells = np.full((9, height, width, 1), neighbours, np.float32)
        cells[4] = frame
        page = torch.from_numpy(lay_out(cells, 3, 3, padding))[None].permute(0, 3, 1, 2)
        # As engines make them, one from the other.
        for _ in range(level):
            page = torch.nn.functional.avg_pool2d(page, 2)
        edges = [(n + padding) / (n + 2 * padding) for n in (height, width)]
        axes = [torch.linspace(1 + 1 - edge, 1 + edge, 60) / 3 for edge in edges]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], -1)[None]
        return torch.nn.functional.grid_sample(page, 2 * grid - 1, align_corners=False, padding_mode="border")

    for level in range(levels + 1):
        assert torch.equal(shown(0.0, level), shown(1000.0, level))
    assert not torch.equal(shown(0.0, levels + 2), shown(1000.0, levels + 2))


def test_what_no_padding_helps():
    with pytest.raises(WlmError, match="mips: 3 levels need .* a multiple of 8 pixels, .* frames of 33 x 32 pixels"):
        mip_padding(32, 33, 3)
    assert mip_levels(33, 32, 16) == 0 and mip_levels(32, 32, 0) == 0


def test_velocities_that_are_missing_or_damaged(folder, tmp_path):
    scene = load_scene("explosion").scaled(0.1).model_copy(update={"frames": 1})
    bare = smoke.open_frames(tmp_path / "bare", scene)
    simulate(bare)
    book = baked(bare.path, (1,))
    with pytest.raises(WlmError, match=r"velocity_0001.npz: the velocity of the air is missing: simulate"):
        open_motion(bare.path)
    with pytest.raises(
        WlmError, match="nowhere: expected a folder of frames from simulate --velocity, found no folder"
    ):
        open_motion(tmp_path / "nowhere")
    with pytest.raises(WlmError, match="frame 1 of the flip book needs frame_0099.npz, which is missing"):
        frames_motion(open_motion(folder), (99,), book)
    path = tmp_path / "velocity.npz"
    for values, words in (
        (np.zeros((2, 2, 2), np.float16), "expected float16"),
        (np.zeros((2, 2, 2, 3)), "expected float16"),
        (np.full((2, 2, 2, 3), np.nan, np.float16), "expected finite numbers"),
    ):
        np.savez(path, velocity=values)
        with pytest.raises(WlmError, match=words):
            read_velocity(path)
    assert read_velocity(velocity_file(folder, 2)).shape[3] == 3
    # Anew without: the old velocities don't stay beside frames that they aren't of.
    smoke.open_frames(bare.path, scene)
    velocity_file(bare.path, 1).write_bytes(b"")
    smoke.open_frames(bare.path, scene)
    assert not velocity_file(bare.path, 1).exists()


def test_the_command(folder, tmp_path):
    """The command writes three textures of one size, and the shader with the range of the motion."""
    words = ["bake", folder, "-o", tmp_path / "six", "--resolution", 32]
    result = CliRunner().invoke(app, [*map(str, words)])
    assert result.exit_code == 0, result.output
    words = ["flipbook", tmp_path / "six", "-o", tmp_path / "book.png", "--motion", folder, "--mips", 2, "--count", 5]
    result = CliRunner().invoke(app, list(map(str, words)))
    assert result.exit_code == 0, result.output
    pages = [Image.open(tmp_path / f"book_{name}.png") for name in (1, 2, "motion")]
    assert {page.size for page in pages} == {(3 * 36, 2 * 36)} and pages[2].mode == "RGB"
    motion = np.asarray(pages[2])
    # A cell without a frame stands still; the greatest motion ends the range.
    assert (motion[36:, 72:, :2] == 127).all() and int(np.abs(motion[..., :2].astype(int) - 127).max()) in (127, 128)
    words[3] = tmp_path / "folder"
    assert CliRunner().invoke(app, list(map(str, words))).exit_code == 0
    assert "wlm_smoke_motion" in (tmp_path / "folder" / "smoke.glsl").read_text()
    result = CliRunner().invoke(app, [*map(str, words[:4]), "--motion", str(tmp_path / "none")])
    assert result.exit_code != 0 and "none" in str(result.exception or result.output)
