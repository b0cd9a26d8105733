"""A map that is saved and read again shows the same; a file that is damaged or hostile is refused in one line."""

import json
from dataclasses import replace

import numpy as np
import pytest
from point_map import CAMERA, SCALE_FACTOR, PointMap, check_map, edge_points

from edgeslam_torch.atlas.atlas_file import COLUMNS, HEADER_KEY, check_fits, is_atlas, read_atlas, write_atlas
from edgeslam_torch.atlas.saved import Unit, pack, unpack
from edgeslam_torch.config import EdgeConfig
from edgeslam_torch.errors import AtlasError
from edgeslam_torch.files.tensor_file import write_tensors
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.types import ScaleEstimate

S = sim3.exp(np.array([0.5, -0.8, 0.3, 0.4, -0.3, 0.6, np.log(1.4)]))
KNOWN = ScaleEstimate(1.0, 0.02, "telemetry")


class Flown:
    """A map of five keyframes with edges and a depth prior on a removed one, and what its cameras see."""

    def __init__(self, rng):
        points = PointMap(rng, 300, 5)
        self.map = points.map
        self.map.begin_piece("first frame")
        points.fill()
        self.edges = EdgeMap(self.map, CAMERA, EdgeConfig())
        gone = points.keyframes[2]
        for keyframe in (gone, points.keyframes[4]):
            uv = rng.uniform(10, 400, (7, 2))
            p_c = CAMERA.back_project(uv, rng.uniform(1, 3, 7))
            own = {"normal": uv / 500, "colour": rng.integers(0, 255, (7, 3)).astype(np.uint8)}
            own |= {"sigma": np.full(7, 0.1), "observations": np.full(7, 3, np.int32)}
            self.edges.hosts.append(edge_points(keyframe.id, p_c, uv=uv, **own))
        anchors = self.map.anchors
        self.guessed = points.keyframes[3].anchor[points.keyframes[3].anchor >= 0][:4]
        anchors.from_depth[self.guessed] = True
        anchors.sigma[:] = 0.1
        anchors.rest_on_prior(self.guessed, gone.id, gone.centre_w, np.tile([0.5, 0.1], (4, 1)))
        anchors.sigma[self.guessed[0]] = np.inf
        self.map.remove_keyframe(gone)

    def saved(self, unit=None):
        return pack(self.map, self.edges, CAMERA, ("monday",), {} if unit is None else {0: unit})


def seen(slam_map, camera=CAMERA):
    """Rays to all anchors from the keyframes that see them, keyframe by keyframe."""
    rays = []
    for id in sorted(slam_map.keyframes):
        keyframe = slam_map.keyframes[id]
        held = keyframe.anchor >= 0
        uv = camera.project(se3.transform(keyframe.T_c_w, slam_map.anchors.p_w[keyframe.anchor[held]]))
        rays.append((uv - keyframe.features.uv[held]) / camera.fx)
    return np.concatenate(rays)


def restored(saved, camera=CAMERA):
    slam_map = SlamMap(SCALE_FACTOR)
    edges = EdgeMap(slam_map, camera, EdgeConfig())
    unpack(saved, slam_map, edges, camera)
    check_map(slam_map)
    return slam_map, edges


def test_a_saved_map_is_the_same_in_output_units(rng, tmp_path):
    flown = Flown(rng)
    write_atlas(tmp_path / "room.atlas", flown.saved(Unit(S, KNOWN)))
    saved = read_atlas(tmp_path / "room.atlas")
    assert (saved.camera, saved.flights, saved.scale, saved.keyframes) == (CAMERA, ("monday",), (KNOWN,), 4)
    slam_map, edges = restored(saved)
    np.testing.assert_allclose(seen(slam_map), seen(flown.map), atol=1e-9)
    before = [flown.map.keyframes[i] for i in sorted(flown.map.keyframes)]
    after = [slam_map.keyframes[i] for i in sorted(slam_map.keyframes)]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_allclose(new.centre_w, sim3.transform(S, old.centre_w[None])[0], atol=1e-9)
        np.testing.assert_array_equal(new.words, old.words)
        assert new.stamp_s == -np.inf, "no time on the clock of any later flight"
    old, new = (m.anchors for m in (flown.map, slam_map))
    a, b = before[0].anchor[before[0].anchor >= 0], after[0].anchor[after[0].anchor >= 0]
    np.testing.assert_allclose(new.max_distance[b], 1.4 * old.max_distance[a])
    np.testing.assert_allclose(new.normal[b], old.normal[a] @ sim3.parts(S)[1].T, atol=1e-9)
    np.testing.assert_array_equal(new.words[b], old.words[a])
    np.testing.assert_array_equal(new.observations[b], old.observations[a])
    guessed = before[2].anchor >= 0
    ids = after[2].anchor[guessed][np.isin(before[2].anchor[guessed], flown.guessed)]
    np.testing.assert_allclose(new.prior[ids], np.tile([0.5, 0.1], (4, 1)) / 1.4)
    np.testing.assert_allclose(new.origin[ids], sim3.transform(S, old.origin[flown.guessed]), atol=1e-9)
    assert np.isinf(new.sigma[ids]).sum() == 1 and new.from_depth.sum() == 4
    assert len(slam_map.begun) == 1 and slam_map.next_keyframe_id() == 5


@pytest.mark.parametrize("far", [1.2e7, np.inf, np.nan])
def test_a_diverged_anchor_is_omitted(rng, tmp_path, far):
    """One keypoint without parallax, 12 000 km off after the last refinement, made a file that could not be read."""
    flown = Flown(rng)
    held = flown.map.latest().anchor
    runaway = held[(held >= 0) & ~np.isin(held, flown.guessed)][0]
    whole = flown.saved().anchors
    flown.map.anchors.p_w[runaway] = far
    write_atlas(tmp_path / "a.atlas", flown.saved())
    saved = read_atlas(tmp_path / "a.atlas")
    assert saved.anchors == whole - 1
    assert len(restored(saved)[0].anchors) == whole - 1


def test_edges_of_removed_keyframes_are_saved(rng, tmp_path):
    flown = Flown(rng)
    write_atlas(tmp_path / "room.atlas", flown.saved(Unit(S, KNOWN)))
    _, edges = restored(read_atlas(tmp_path / "room.atlas"))
    for slam_map, hosts in ((flown.map, flown.edges.hosts), (edges.map, edges.hosts)):
        p_w = np.concatenate([se3.transform(se3.inverse(slam_map.pose_of(h.keyframe_id)), h.p_c) for h in hosts])
        if slam_map is flown.map:
            expected = sim3.transform(S, p_w)
        else:
            np.testing.assert_allclose(p_w, expected, atol=1e-5)
    assert [h.sigma[0] for h in edges.hosts] == pytest.approx([0.14, 0.14])
    assert edges.hosts[0].observations.tolist() == [3] * 7


def test_repeated_saving_and_loading_preserves_the_map(rng, tmp_path):
    path = tmp_path / "room.atlas"
    write_atlas(path, Flown(rng).saved(Unit(np.eye(4), KNOWN)))
    first = path.read_bytes()
    slam_map, edges = restored(read_atlas(path))
    unit = Unit(np.eye(4), KNOWN)
    write_atlas(path, pack(slam_map, edges, CAMERA, ("monday",), {0: unit}))
    assert path.read_bytes() == first


def test_submaps_stay_separate_and_have_their_own_units(rng, tmp_path):
    flown = Flown(rng)
    other = Flown(np.random.default_rng(5)).saved()
    unpack_into = flown.map.add_piece("second")
    keyframe = flown.map.keyframes[4]
    flown.map._piece[keyframe.id] = unpack_into
    shared = keyframe.keypoints_with_anchor()
    flown.map.forget_observations(keyframe, shared[: len(shared) - 20])
    saved = flown.saved(Unit(S, KNOWN))
    assert [s.units for s in saved.scale] == ["metres", "arbitrary"]
    slam_map, _ = restored(saved)
    assert [slam_map.piece_of(i) for i in sorted(slam_map.keyframes)] == [0, 0, 0, 1]
    assert [s.units for s in other.scale] == ["arbitrary"]


def test_pixels_are_those_of_the_new_camera(rng):
    flown = Flown(rng)
    other = Camera(640, 480, 350.0, 345.0, 300.0, 250.0)
    slam_map, edges = restored(flown.saved(), other)
    np.testing.assert_allclose(seen(slam_map, other), seen(flown.map), atol=2e-6)
    for host in edges.hosts:
        np.testing.assert_allclose(other.project(host.p_c), host.uv, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"fx": 640.0, "fy": 640.0}, "made with another camera .640x480, f 320 px; this one: 640x480, f 640 px"),
        ({"fy": 200.0}, "made with another camera"),
    ],
)
def test_an_atlas_of_another_lens_is_rejected(rng, tmp_path, change, match):
    saved = Flown(rng).saved()
    check_fits(saved, replace(CAMERA, fx=330.0), SCALE_FACTOR, tmp_path)
    with pytest.raises(AtlasError, match=match):
        check_fits(saved, replace(CAMERA, **change), SCALE_FACTOR, tmp_path)
    with pytest.raises(AtlasError, match="made with orb.scale_factor 1.2, this run has 1.5"):
        check_fits(saved, CAMERA, 1.5, tmp_path)


def test_an_atlas_with_more_pyramid_levels_is_rejected_with_a_remedy(rng, tmp_path):
    saved = Flown(rng).saved()
    used = int(saved.arrays["keypoint.octave"].max()) + 1
    check_fits(saved, CAMERA, SCALE_FACTOR, tmp_path, used)
    with pytest.raises(AtlasError, match=f"--set orb.levels={used}"):
        check_fits(saved, CAMERA, SCALE_FACTOR, tmp_path, used - 1)


@pytest.mark.parametrize(("metres", "sigma"), [(1.0, 1e-9), (1000.0, 1e-9), (1000.0, 20.0), (1e-4, 1e-5)])
def test_implausible_scales_are_rejected(rng, tmp_path, metres, sigma):
    saved = Flown(rng).saved()
    scale = tuple(ScaleEstimate(metres, sigma, "depth") for _ in saved.scale)
    write_atlas(tmp_path / "a.safetensors", replace(saved, scale=scale))
    with pytest.raises(AtlasError, match="metres a unit"):
        read_atlas(tmp_path / "a.safetensors")


# -- files that are refused --------------------------------------------------------------------------------------


def refused(path, match="."):
    with pytest.raises(AtlasError, match=match) as caught:
        read_atlas(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and "\n" not in text and len(text) < 500


def test_other_files_are_rejected(tmp_path):
    refused(tmp_path / "none", "no such atlas file")
    refused(tmp_path, "no such atlas file")
    (tmp_path / "text").write_text("an atlas")
    refused(tmp_path / "text", "not a safetensors file")
    write_tensors(tmp_path / "weights", {"edgeslam": "{}"}, {"conv": np.zeros(3, np.float32)})
    refused(tmp_path / "weights", "it contains no atlas")
    assert not any(is_atlas(tmp_path / name) for name in ("text", "weights", "none"))


def test_every_truncated_file_is_rejected(rng, tmp_path):
    path = tmp_path / "room.atlas"
    write_atlas(path, Flown(rng).saved())
    whole = path.read_bytes()
    assert is_atlas(path)
    for length in [*range(0, 5000, 499), *range(5000, len(whole), 20011), len(whole) - 1]:
        path.write_bytes(whole[:length])
        refused(path)


@pytest.mark.parametrize("seed", range(8))
def test_flipped_bytes_give_an_atlas_or_one_line(rng, tmp_path, seed):
    """Whatever is in the file: it is refused, or the map is consistent."""
    path, dice = tmp_path / "room.atlas", np.random.default_rng(seed)
    write_atlas(path, Flown(rng).saved())
    content = bytearray(path.read_bytes())
    end = len(content) if seed % 2 else 5000
    for position in dice.integers(8, end, 3):
        content[position] = dice.integers(0, 256)
    path.write_bytes(bytes(content))
    try:
        saved = read_atlas(path)
    except AtlasError as error:
        assert "\n" not in str(error)
    else:
        restored(saved)


def set_row(name, row, value):
    def change(arrays):
        arrays[name] = arrays[name].copy()
        arrays[name][row] = value

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (set_row("anchor.p_w", (0, 0), np.nan), "anchor.p_w has values that are not finite"),
        (set_row("keyframe.T_c_w", (1, 0, 0), 3.0), "not rigid"),
        (set_row("keyframe.id", 0, 77), "not numbered consecutively"),
        (set_row("keyframe.piece", slice(None), -1), "pieces and keyframes"),
        (set_row("removed.heir", 0, 2), "has no successor"),
        (set_row("keyframe.keypoints", 0, 10_000_000), "do not add up"),
        (set_row("keypoint.anchor", 0, 10_000_000), "missing anchor"),
        (set_row("keypoint.anchor", slice(0, 2), 3), "observes an anchor twice"),
        (set_row("keypoint.octave", 0, 99), "invalid pyramid level"),
        (set_row("keypoint.uv", (0, 0), 1e5), "outside the image"),
        (set_row("host.keyframe", 0, 9), "missing keyframe"),
        (set_row("edge.sigma", 0, 0.0), "not positive"),
        (set_row("edge.p_c", (0, 2), -1.0), "behind its camera"),
        (set_row("anchor.visible", 0, -1), "not a count"),
        (set_row("anchor.from_depth", slice(None), 1), "depth prior refers to a missing keyframe"),
        (lambda a: a.pop("anchor.found"), "it has no column anchor.found"),
        (lambda a: a.update({"anchor.found": a["anchor.found"][:-1]}), "anchor.found has .* rows, others"),
        (lambda a: a.update({"anchor.found": a["anchor.found"].astype(np.float64)}), "anchor.found is F64"),
        (lambda a: a.update({n: v[:0] for n, v in a.items()}), "no keyframe"),
    ],
)
def test_inconsistent_tables_are_rejected(rng, tmp_path, change, match):
    saved = Flown(rng).saved()
    write_atlas(tmp_path / "right", saved)
    arrays = {name: saved.arrays[name] for name in COLUMNS}
    change(arrays)
    write_tensors(tmp_path / "wrong", {HEADER_KEY: header_of(tmp_path / "right")}, arrays)
    refused(tmp_path / "wrong", match)


def header_of(path):
    with path.open("rb") as file:
        return json.loads(file.read(int.from_bytes(file.read(8), "little")))["__metadata__"][HEADER_KEY]


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('"version": 1', '"version": 2', "version 2; this program reads version 1"),
        ('"fx": 320.0', '"fx": -1', "fx must be"),
        ('"fx": 320.0', '"f": 1', "camera in its header is invalid"),
        ('"width": 640', '"width": 0', "width must be"),
        ('"scale_factor": 1.2', '"scale_factor": 0', "scale_factor must be"),
        ('"pieces": [', '"pieces": 3, "others": [', "pieces"),
        ('"flights": [', '"flights": [3, ', "flights"),
        ('"metres": 1.0', '"metres": 0', "metres must be"),
        ("{", "[" * 10_000 + "{", "nested"),
    ],
)
def test_an_invalid_header_is_rejected(rng, tmp_path, old, new, match):
    saved = Flown(rng).saved(Unit(np.eye(4), KNOWN))
    write_atlas(tmp_path / "right", saved)
    text = header_of(tmp_path / "right")
    assert old in text
    write_tensors(tmp_path / "wrong", {HEADER_KEY: text.replace(old, new, 1)}, saved.arrays)
    refused(tmp_path / "wrong", match)
