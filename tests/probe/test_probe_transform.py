"""A transform's file: what is coded comes back, has the wanted size or error, and refuses what isn't its own."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from builders.probe_sets import synthetic

import wlm
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.compact import BODY
from wlm.probe import entropy
from wlm.probe.between import held_out
from wlm.probe.data import from_arrays
from wlm.probe.kriging import Kriging
from wlm.probe.transform import Places, TransformModel, basis
from wlm.probe.transform_coder import Coders
from wlm.probe.transform_fit import Frame, Search, Team
from wlm.probe.tree import RADII, Tree, flat
from wlm.workers import Here
from wlm_kernels.probe.mixture import mix

RANDOM = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def _same_numbers(monkeypatch):
    monkeypatch.setitem(globals(), "RANDOM", np.random.default_rng(0))


def lattice(side=6, outputs=12):
    """A lattice with smooth light, [side³] probes, every 50th of them dead."""
    place = np.stack(np.meshgrid(*[np.arange(side) * 0.5] * 3, indexing="ij"), -1).reshape(-1, 3)
    wave = np.sin(place @ RANDOM.normal(size=(3, outputs)) + RANDOM.normal(size=outputs))
    values = (wave + RANDOM.normal(size=wave.shape) * 0.01).astype(np.float32)
    values[::50] = 0.0
    return from_arrays(place, values, name="lattice")


def searched(probes):
    """The search of a set for the usual PSNR."""
    frame, team = Frame(probes, False, probes.probes), Team(Here(Coders()), 1)
    return Search(probes, wlm.probe.Profile.load("transform"), frame, team, None)


@pytest.mark.parametrize("kind", ["zeros", "small", "large", "one"])
def test_whole_numbers_come_back(kind):
    place = RANDOM.integers(0, 65536, (1 if kind == "one" else 300, 3))
    tree = Tree(place)
    size = {"zeros": 0, "small": 2, "large": 2.0**22, "one": 9}[kind]
    q = np.rint(RANDOM.laplace(size=(len(place), 5)) * size / 12).astype(np.int64)
    q[-1, -1] = entropy.LARGEST if kind == "large" else 0
    shape = entropy.Shape(5, tree.levels, tree.parents)
    data = entropy.pack((q, shape))
    np.testing.assert_array_equal(entropy.unpack(data, shape)[0], q)
    twice = entropy.pack((q[:1], entropy.Shape(5, flat(1))), (q, shape))
    np.testing.assert_array_equal(entropy.unpack(twice, entropy.Shape(5, flat(1)), shape)[1], q)
    if kind == "zeros":
        assert len(data) < 24
    with pytest.raises(ValueError):
        entropy.unpack(data + bytes(-len(data) % 4) + b"\x01\0\0\0", shape)


def test_odds_follow_what_is_known():
    # Laplacian numbers of one scale take their entropy; where it is a row's own, less than if nothing were known of it.
    for spread, most in ((0.0, 1.02), (1.5, 0.97)):
        scale = np.exp(RANDOM.normal(size=(4000, 1)) * spread)
        q = np.rint(RANDOM.laplace(size=(4000, 5)) * scale).astype(np.int64)
        share = np.unique(q, return_counts=True)[1] / q.size
        alone = -q.size * (share * np.log2(share)).sum()
        assert 8 * len(entropy.pack((q, entropy.Shape(5, flat(4000))))) < most * alone


@pytest.mark.parametrize("grid", [0, 1])
@pytest.mark.parametrize("shape", ["scattered", "lattice", "line", "coincident"])
def test_a_tree_is_undone_and_transposed(shape, grid):
    place = RANDOM.integers(0, 65536, (200, 3))
    if shape == "lattice":
        place = np.stack(np.meshgrid(*[np.arange(6) * 13107] * 3, indexing="ij"), -1).reshape(-1, 3)
    if shape == "line":
        place[:, :2] = 7
    if shape == "coincident":
        place[50:] = place[:1]
    tree = Tree(place, grid)
    assert sorted(np.concatenate(tree.levels)) == list(range(len(place)))
    a, b = RANDOM.normal(size=(2, len(place), 4))
    np.testing.assert_allclose(tree.values(tree.coefficients(a)), a, atol=1e-9)
    assert np.vdot(tree.values(a), b) == pytest.approx(np.vdot(a, tree.adjoint(b)))


def test_spread_levels_are_those_of_one_probe_after_the_other():
    code = RANDOM.integers(0, 65536, (400, 3)) // [1, 1, 40]
    code[350:] = code[:50]
    order = sorted(range(400), key=lambda i: i * 2654435761 % 2**32)
    square, taken, levels = RADII[1] ** 2, [], []
    while len(taken) < 400:
        before = len(taken)
        for i in order:
            apart = np.square(code[i] - code[taken]).sum(-1) >= square
            if i not in taken and (apart.all() or square < 64):
                taken.append(i)
        if len(taken) > before:
            levels.append(sorted(taken[before:]))
        square //= 4
    assert [level.tolist() for level in Tree(code, 1).levels] == levels


def test_parents_are_the_first_of_those_that_are_as_far():
    side = np.arange(6) * 8192 + 4096
    place = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    place = np.concatenate([place, place[:40]])[RANDOM.permutation(256)]
    # A middle that comes last, with 30 as far from it.
    ring = np.unique(
        np.concatenate([np.array([[3, 4, 0], [5, 0, 0]])[:, axes] for axes in [[0, 1, 2], [1, 2, 0]]]), axis=0
    )
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 1, 3)
    ring = np.unique((ring * signs).reshape(-1, 3), axis=0)
    for code in (
        place,
        np.concatenate([[[0, 0, 0]], 30000 + 2000 * RANDOM.permutation(ring), [[30001, 30000, 30000]]]),
    ):
        tree = Tree(code)
        known = tree.levels[0]
        for level, parents in zip(tree.levels[1:], tree.parents, strict=True):
            far = np.square(code[level][:, None] - code[known]).sum(-1)
            first = np.lexsort((np.broadcast_to(np.arange(len(known)), far.shape), far), axis=-1)[:, : parents.shape[1]]
            np.testing.assert_array_equal(np.sort(parents, 1), np.sort(known[first], 1))
            known = np.concatenate([known, level])


def test_odds_are_the_same_in_any_order_of_summing():
    odds = entropy._Odds(1)
    for _ in range(40):
        odds.count(7, RANDOM.integers(0, 50, 999))
    odds = odds._count[7] / entropy._UNIT
    sums = {np.cumsum(RANDOM.permutation(odds))[-1] for _ in range(50)}
    assert len(sums) == 1 and odds.min() > 0


def test_kriging_is_exact_at_places_even_and_without_jumps():
    place = RANDOM.random((100, 3))
    kriging = Kriging(place)
    light = np.stack([np.ones(100), place @ [1.0, -2.0, 3.0], RANDOM.normal(size=100)], 1)

    def at(point):
        index, weight = kriging.weights(point)
        return (light[index] * weight[..., None]).sum(1)

    np.testing.assert_array_equal(at(place), light)
    path = np.linspace([0.1, 0.2, 0.3], [0.9, 0.7, 0.8], 20001)
    np.testing.assert_allclose(at(path)[:, 0], 1.0, atol=1e-9)
    # The K nearest change some fifty times on the way: the largest step is no more than a steep slope's.
    assert np.abs(np.diff(at(path)[:, 2])).max() < 5e-3


@pytest.mark.parametrize("outputs", [3, 9, 12, 27])
def test_rows_are_mixed_in_threads_of_one_number_or_nine(outputs):
    random = np.random.default_rng(outputs)
    rows, weight = random.normal(size=(30, outputs)), random.normal(size=(50, 12)) * (random.random((50, 12)) < 0.7)
    index = random.integers(0, 30, (50, 12))
    inputs = wp.array(rows, dtype=float), wp.array(index, dtype=int), wp.array(weight, dtype=float)
    out = wp.full((50, outputs), np.nan, dtype=float)
    mix(*inputs, out)
    np.testing.assert_allclose(out.numpy(), (weight[:, :, None] * rows[index]).sum(1), atol=1e-5)


def test_the_basis_is_orthonormal_and_begins_with_the_directions():
    vectors = np.linalg.qr(RANDOM.normal(size=(27, 27)))[0][:5]
    rounded = np.rint(vectors * 64) / 64
    found = basis(27, rounded)
    np.testing.assert_allclose(found.T @ found, np.eye(27), atol=1e-12)
    along = np.abs(np.einsum("vd,dv->v", rounded @ basis(27, None).T, found[:, :5]))
    assert (along > 0.97).all()


@pytest.mark.parametrize("asked", [{"target_psnr": 30.0}, {"target_psnr": 60.0}, {"max_bytes": 600}])
def test_the_file_is_as_asked(asked, tmp_path):
    probes = lattice()
    model = wlm.probe.compress(probes, positions="max_bytes" in asked, **asked)
    size = model.save(tmp_path / "a.wlm")
    report = wlm.probe.evaluate(wlm.load(tmp_path / "a.wlm"), probes)
    if "target_psnr" in asked:
        assert asked["target_psnr"] <= report.psnr < asked["target_psnr"] + 1.0
    else:
        assert 0.9 * 600 < size <= 600
    assert not model.decoder().decode_probes(probes.position)[~probes.live].any()


def test_what_cannot_be_had_is_one_line():
    probes = lattice()
    with pytest.raises(WlmError, match="--max-bytes: expected at least .* for lattice, got 20"):
        wlm.probe.compress(probes, max_bytes=20)
    with pytest.raises(WlmError, match="ratio: expected a profile of the method gaussians, found transform"):
        wlm.probe.compress(probes, ratio=0.1)
    with pytest.raises(WlmError, match="max_bytes: expected a profile of the method transform, found standard"):
        wlm.probe.compress(probes, "standard", max_bytes=1000)


@pytest.mark.parametrize("positions", [False, True])
def test_a_file_comes_back_and_knows_its_places(positions, tmp_path):
    probes = lattice()
    model = wlm.probe.compress(probes, positions=positions)
    size = model.save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm")
    assert isinstance(back, TransformModel) and size == model.file_bytes()
    back.save(tmp_path / "b.wlm")
    assert (tmp_path / "a.wlm").read_bytes() == (tmp_path / "b.wlm").read_bytes()
    decoder = back.decoder()
    if positions:
        assert size < wlm.probe.compress(probes).file_bytes() + 150
        np.testing.assert_allclose(back.stored_positions(), probes.position, atol=2.5 / 65535)
    else:
        with pytest.raises(WlmError, match="a: the file has no positions"):
            decoder.decode(probes.position)
        with pytest.raises(WlmError, match="a: holds no positions"):
            decoder.decode_probes()
    for other in (probes.position[::-1], probes.position + [[0.1, 0, 0]] * (np.arange(216) == 5)[:, None]):
        with pytest.raises(WlmError, match="a: expected the positions of its own 216 probes"):
            back.decoder().decode_probes(other)
    values = decoder.decode_probes(probes.position.astype(np.float32))
    np.testing.assert_array_equal(values, model.decoder().decode_probes(probes.position))
    # A place as the file has it is a 65535th of the box from the probe at most.
    between, slack = decoder.decode(probes.position[probes.live]), 1e-3 if positions else 0.0
    np.testing.assert_allclose(between, values[probes.live], rtol=0, atol=slack * np.abs(values).max())


HARD = {
    "one probe": (1, 3),
    "two": (2, 27),
    "coincident": (30, 5),
    "constant": (30, 12),
    "one number": (30, 1),
    "far": (30, 27),
    "huge": (30, 27),
    "tiny": (30, 27),
    "wide": (30, 27),
}


@pytest.mark.parametrize("kind", HARD)
def test_hard_sets(kind, tmp_path):
    count, outputs = HARD[kind]
    place, values = RANDOM.random((count, 3)) * 4, RANDOM.normal(size=(count, outputs)).astype(np.float32)
    place = np.repeat(place[:1], count, 0) if kind == "coincident" else place + 1e9 * (kind == "far")
    place = place * 1e60 if kind == "wide" else place
    if kind == "constant":
        values[:] = 0.25
    values = values * np.float32({"huge": 1e17, "tiny": 1e-20}.get(kind, 1.0))
    probes = from_arrays(place, values)
    wlm.probe.compress(probes, positions=True).save(tmp_path / "a.wlm")
    decoder = wlm.load(tmp_path / "a.wlm").decoder()
    decoded = decoder.decode_probes()
    error = np.sqrt(np.square(decoded.astype(np.float64) - values).mean())
    assert error <= 0.01 * np.abs(values).max()
    assert np.isfinite(decoder.decode(place + 0.3)).all()


def test_a_file_without_a_live_probe_is_one_line(tmp_path):
    model = wlm.probe.compress(lattice(), positions=True)
    with pytest.raises(WlmError, match="expected 1 to .* live probes .* found 0"):
        dataclasses.replace(model, dead=np.ones(216, bool)).save(tmp_path / "a.wlm")


def test_more_probes_than_the_bytes_can_tell_are_refused_before_they_are_placed(tmp_path):
    model = wlm.probe.compress(lattice(outputs=1), positions=True)
    many = Places(np.zeros(3), 1.0, np.zeros((1 << 20, 3), np.uint16))
    with pytest.raises(WlmError, match="live probes of .* bytes, found 1048576"):
        dataclasses.replace(model, probes=1 << 20, dead=np.zeros(0, bool), places=many).save(tmp_path / "a.wlm")


@pytest.mark.slow
def test_held_out_probes_of_a_file_with_places_get_no_bytes_for_them():
    probes = synthetic(200)
    plain, placed = (wlm.probe.compress(probes, positions=positions) for positions in (False, True))
    assert placed.file_bytes() > plain.file_bytes() + 500
    assert held_out(placed, probes) == held_out(plain, probes)


def test_the_head_is_short(tmp_path):
    probes = synthetic(8)
    model = wlm.probe.compress(probes, max_bytes=60)
    assert model.save(tmp_path / "a.wlm") - len(model.stream) <= 24
    assert wlm.load(tmp_path / "a.wlm").name == "a"
    assert probes.source.startswith(model.source)


def test_an_earlier_file_is_written_as_it_was(tmp_path):
    earlier = Path(__file__).parents[1] / "files" / "probe-transform.wlm"
    wlm.load(earlier).save(tmp_path / "a.wlm")
    assert (tmp_path / "a.wlm").read_bytes() == earlier.read_bytes()


def test_damage_that_is_signed_is_one_line_or_decodes(tmp_path):
    model = wlm.probe.compress(lattice(), positions=True)
    model.save(tmp_path / "a.wlm")
    body = read_artifact(tmp_path / "a.wlm").tensors[BODY]
    refused = 0
    for at in range(80):
        for changed in (np.concatenate([body[:at], body[at:] ^ (np.arange(len(body) - at) == 0)]), body[:at]):
            write_artifact(tmp_path / "b.wlm", "probe", {}, {BODY: changed.astype(np.uint8)}, "")
            try:
                values = wlm.load(tmp_path / "b.wlm").decoder().decode_probes()
            except WlmError as error:
                refused += 1
                assert "b.wlm" in str(error) and "\n" not in str(error)
            else:
                assert np.isfinite(values).all()
    assert refused > 60


def test_light_between_probes_is_better_than_by_distance():
    probes = synthetic(400)
    held = np.arange(400) % 5 == 4
    known = from_arrays(probes.position[~held], probes.values[~held])
    decoder = wlm.probe.compress(known, target_psnr=50.0).decoder(position=known.position)
    error = np.square(decoder.decode(probes.position[held]) - probes.values[held]).mean()
    index, distance = (Kriging(known.position)._tree.query(probes.position[held], k=8)[i] for i in (1, 0))
    weight = distance**-2.0
    plain = (known.values[index] * (weight / weight.sum(1, keepdims=True))[..., None]).sum(1)
    assert error < np.square(plain - probes.values[held]).mean()


def test_places_are_the_same_from_floats():
    place = RANDOM.random((50, 3)) * 30 - 10
    one, two = Places.of(place), Places.of(place.astype(np.float32).astype(np.float64))
    np.testing.assert_array_equal(one.code, two.code)
    assert one.check == two.check != dataclasses.replace(one, code=one.code[::-1]).check


def test_a_fit_of_few_probes_does_not_diverge():
    # Late in the power method one probe's part outgrows the others.
    probes = synthetic(100, coefficients=4, dead=3)
    lit = np.flatnonzero(probes.live)
    few = from_arrays(*(part[lit[np.arange(len(lit)) % 5 != 4]] for part in (probes.position, probes.values)))
    tree = Tree(Places.of(few.position).code)
    matrix = tree.values(np.eye(few.probes) / tree.reach[:, None])
    assert tree.eigenvalue == pytest.approx(np.linalg.eigvalsh(matrix.T @ matrix)[-1], rel=1e-3)
    search = searched(few)
    fitted, rough = search.at_step(0.1), search.rough_bytes(0.1)
    assert fitted.size < rough and fitted.error < 2.0 * 0.1**2 * few.values.size


def test_a_psnr_that_comes_nearer_and_nearer_is_reached(monkeypatch):
    probes = synthetic(40, coefficients=1)
    search = searched(probes)
    # An octave of the step gains an eighth of what is expected.
    monkeypatch.setattr(search, "_psnr", lambda coded: 40.0 - 0.6 * np.log2(coded.step))
    coded = search.smallest(45.0)
    assert 45.0 <= search._psnr(coded) < 45.2
