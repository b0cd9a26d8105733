"""The live pose is transformed when its submap is."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.atlas.atlas import MapChange
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.estimation.scale.belief import ScaleBelief
from edgeslam_torch.estimation.scale.submap_scale import SubmapScale
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.states.map_merging import MapMerging
from edgeslam_torch.tracking.motion_model import MotionModel
from edgeslam_torch.types import ScaleEstimate

S = sim3.exp(np.array([0.4, -0.2, 0.7, 0.3, -0.5, 0.2, np.log(1.5)]))
KEYFRAME = 7


class Pieces:
    """A map of two submaps; the camera is in number 1."""

    def __init__(self, T_k_w):
        self.T_k_w, self.piece = T_k_w, 1
        self.begun = {0: "first", 1: "second"}
        self.queries = 0

    @property
    def present(self):
        return self.piece

    def whole(self, piece):
        return min(piece, self.piece)

    def piece_of(self, keyframe_id):
        return self.piece

    def pose_of(self, keyframe_id):
        assert keyframe_id == KEYFRAME
        return self.T_k_w

    def atlas(self, moved):
        """Finds one merge that moves submap number ``moved``."""

        def update():
            self.queries += 1
            if self.piece == 0:
                return None
            self.piece = 0
            if moved == 1:
                self.T_k_w = sim3.moved_camera(S, self.T_k_w)
            return MapChange("joined", 1.0, "piece 1 joined piece 0", {KEYFRAME: 1.5} if moved == 1 else {3: 1.5})

        return SimpleNamespace(
            update=update,
            search_all_again=lambda: None,
            is_up_to_date=False,
            is_divided=True,
            known_scale={},
        )


def system_of(pieces, motion, busy=False):
    log = SimpleNamespace(
        records=[SimpleNamespace(keyframe_id=KEYFRAME)],
        poses=lambda: ("stamps", "poses"),
        support=lambda: SimpleNamespace(largest=lambda: pieces.piece),
    )
    revised = []
    remembered = []
    fusion = SimpleNamespace(
        submaps={},
        piece=1,
        entered=[],
        enter=lambda piece: fusion.entered.append(piece),
        join=lambda whole: None,
        revise=lambda *poses: revised.append(poses),
        revised=revised,
        scale=lambda: ScaleEstimate(2.0, 0.02, "telemetry"),
        metres=SimpleNamespace(remember=remembered.append),
        remembered=remembered,
    )
    mapping = SimpleNamespace(busy=busy)
    again = lambda: revised.append("ratios")  # noqa: E731
    return SimpleNamespace(
        compare_depths_again=again,
        log=log,
        map=pieces,
        motion=motion,
        fusion=fusion,
        mapping=mapping,
        published=OutputFrame(2.0),
        graph=pieces,
        events={},
    )


def moving(rng):
    """A moving camera at some distance from its keyframe."""
    T_k_w = se3.exp(rng.normal(size=6))
    motion = MotionModel(se3.exp(0.1 * rng.normal(size=6)) @ T_k_w)
    motion.stamp_s = 1.0
    motion.move(1.1, se3.exp(0.1 * rng.normal(size=6)) @ motion.T_c_w)
    motion.stamp_s = 1.1
    return T_k_w, motion


@pytest.mark.parametrize("moved", [1, 0])
def test_pose_and_velocity_are_transformed_with_their_submap_only(rng, moved):
    """The view of the submap, now and by prediction, stays the same up to scale."""
    T_k_w, motion = moving(rng)
    p = rng.normal(size=(20, 3))
    before = np.array([se3.transform(T, p) for T in (motion.T_c_w, motion.predict(1.3))])
    system = system_of(Pieces(T_k_w), motion)
    assert MapMerging(system, system.map.atlas(moved)).update().startswith("piece 1 joined piece 0")
    there = sim3.transform(S, p) if moved else p
    after = [se3.transform(T, there) for T in (motion.T_c_w, motion.predict(1.3))]
    np.testing.assert_allclose(after, (1.5 if moved else 1.0) * before, atol=1e-9)
    assert (system.published.scale, system.published.revision) == (2.0, 1)
    assert system.events == {"joined": 1}
    assert system.fusion.revised == ["ratios", ("stamps", "poses")], "in the submap's new scale"
    assert system.map.queries == 2, "until there is no other merge"


@pytest.mark.parametrize("finish", [False, True])
def test_no_merge_while_the_worker_maps(rng, finish):
    T_k_w, motion = moving(rng)
    system = system_of(Pieces(T_k_w), motion, busy=True)
    joining = MapMerging(system, system.map.atlas(moved=1))
    if finish:
        joining.finish()
    else:
        assert joining.update() == ""
    assert system.map.queries == 0
    assert system.events == {}


def test_the_scale_of_an_earlier_flight_applies_in_its_submap_only(rng):
    T_k_w, motion = moving(rng)
    system = system_of(Pieces(T_k_w), motion)
    atlas = system.map.atlas(moved=1)
    known = ScaleEstimate(1.0, 0.02, "depth")
    atlas.known_scale[0] = known
    joining = MapMerging(system, atlas)
    joining.enter(1)
    assert (system.published.scale, system.published.revision) == (2.0, 0)
    joining.enter(0)
    assert (system.published.scale, system.published.revision) == (1.0, 1), "listeners get a new revision"
    joining.enter(0)
    system.published = OutputFrame(1.1, revision=2)  # telemetry has contradicted it since
    joining.enter(0)
    assert (system.published.scale, system.published.revision) == (1.1, 2)
    assert system.fusion.remembered == [None, known]


@pytest.mark.parametrize("turned", [False, True])
def test_the_axes_of_an_earlier_flight_apply_in_its_map(rng, turned):
    """A world frame levelled by this flight's attitude differs from the earlier one."""
    T_k_w, motion = moving(rng)
    system = system_of(Pieces(T_k_w), motion)
    R_w_m = se3.exp(np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0]))[:3, :3]
    system.published = OutputFrame(1.0).turned_upright(R_w_m if turned else None, True)
    atlas = system.map.atlas(moved=1)
    atlas.known_scale[0] = ScaleEstimate(1.0, 0.02, "depth")
    MapMerging(system, atlas).enter(0)
    np.testing.assert_array_equal(system.published.R, np.eye(3))
    assert system.published.revision == 2 * int(turned)
    assert system.published.turned_upright(R_w_m, True) is system.published


def scaling(rng, monkeypatch, piece, measured, sigma=0.03):
    """A camera in a submap that began at keyframe 5, whose scale is measured at half of the map's: what was moved."""
    T_k_w, motion = moving(rng)
    pieces = Pieces(T_k_w)
    pieces.keyframes, pieces.piece_of = {3: 0, 5: 1, KEYFRAME: piece}, lambda id: pieces.keyframes[id]
    began, moved = se3.exp(rng.normal(size=6)), []
    pieces.pose_of = lambda id: began if id == 5 else pieces.T_k_w
    system = system_of(pieces, motion)
    atlas = pieces.atlas(moved=1)
    atlas.graph = SimpleNamespace(starts={1: SimpleNamespace(keyframe_id=5), 2: SimpleNamespace(keyframe_id=KEYFRAME)})
    atlas.is_up_to_date, atlas.edges = True, None
    before = ScaleBelief(0.3, 0.02, "telemetry")
    found = ScaleBelief(0.3 + np.log(measured), sigma, "height")
    system.fusion.submaps[1] = SubmapScale(before, found)

    def move(slam_map, edges, log, S):
        moved.append(S)
        pieces.T_k_w = sim3.moved_camera(S[KEYFRAME], pieces.T_k_w)
        return dict.fromkeys(S, sim3.scale_of(S[KEYFRAME]))

    monkeypatch.setattr("edgeslam_torch.states.map_merging.move", move)
    p = rng.normal(size=(20, 3))
    views = [se3.transform(motion.T_c_w, p)]
    MapMerging(system, atlas).update()
    if moved:
        p = sim3.transform(moved[0][KEYFRAME], p)
    views.append(se3.transform(motion.T_c_w, p))
    return system, moved, se3.inverse(began)[:3, 3], views


def test_a_submap_is_brought_to_the_maps_unit_about_its_beginning(rng, monkeypatch):
    system, (S,), began, (before, after) = scaling(rng, monkeypatch, 1, measured=0.5)
    assert set(S) == {5, KEYFRAME}, "of this submap alone"
    np.testing.assert_allclose(sim3.transform(S[5], began[None])[0], began, atol=1e-12)
    np.testing.assert_allclose(after, 0.5 * before, atol=1e-9)
    assert system.published.revision == 1 and system.events == {"scaled": 1}
    assert system.fusion.submaps[1].growth == pytest.approx(1.0), "it grows once"


def test_a_submap_measured_as_well_as_the_map_is_of_one_unit_with_it(rng, monkeypatch):
    system, moved, _, _ = scaling(rng, monkeypatch, 1, measured=0.99, sigma=0.02)
    assert len(moved) == 1 and not system.fusion.submaps


@pytest.mark.parametrize(
    ("piece", "measured", "sigma"),
    [(1, 0.97, 0.03), (1, 0.5, 0.2), (0, 0.5, 0.03), (2, 0.5, 0.03)],
    ids=["of the map's unit", "not yet known", "the first submap", "another submap"],
)
def test_other_submaps_stay(rng, monkeypatch, piece, measured, sigma):
    system, moved, _, (before, after) = scaling(rng, monkeypatch, piece, measured, sigma)
    np.testing.assert_array_equal(before, after)
    assert not moved and set(system.fusion.submaps) == {1}


@pytest.mark.parametrize("sigma", [0.03, 0.3])
def test_the_result_is_the_largest_submap_wherever_the_camera_is(rng, sigma):
    """Its heading and scale are looked for again; one that was never measured stays uncertain."""
    T_k_w, motion = moving(rng)
    system = system_of(Pieces(T_k_w), motion)
    atlas = system.map.atlas(moved=1)
    atlas.is_divided, atlas.is_up_to_date, system.map.piece_of = False, True, lambda id: 0
    system.log.support = lambda: SimpleNamespace(largest=lambda: 0)
    atlas.graph = SimpleNamespace(starts={})
    system.fusion.submaps[0] = SubmapScale(ScaleBelief(0.3, 0.02, "telemetry"), ScaleBelief(0.3, sigma, "height"))
    MapMerging(system, atlas).finish()
    assert (0 in system.fusion.submaps) == (sigma > 0.1)
    assert system.fusion.entered == [0] and system.fusion.revised == [("stamps", "poses")]
