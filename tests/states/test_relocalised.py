"""Relocalisation is gated by the pose that the drone's sensors predict."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.atlas.links import Link
from edgeslam_torch.atlas.saved import BEFORE_S
from edgeslam_torch.atlas.submap_graph import SubmapGraph
from edgeslam_torch.estimation.filter.filter_feed import PoseEstimate
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.states.tracking import Tracking
from edgeslam_torch.types import ScaleEstimate


def placed(x):
    """Camera-to-world pose at ``(x, 0, 0)``."""
    T_w_c = np.eye(4)
    T_w_c[0, 3] = x
    return T_w_c


class Flown:
    """Six keyframes along five units, the newest of which was tracked last; its points are two units away."""

    def __init__(self, sigma=0.01, earlier=False, between=np.inf):
        self.between = between
        stamps = [BEFORE_S if earlier and k < 3 else float(k) for k in range(6)]
        self.keyframes = {
            k: SimpleNamespace(
                id=k,
                centre_w=np.array([float(k), 0.0, 0.0]),
                stamp_s=stamps[k],
                anchor=np.zeros(int(k >= 4), dtype=np.int64),
            )
            for k in range(6)
        }
        self.piece_of = dict.fromkeys(range(6), 0)
        self.predicted = PoseEstimate(placed(5.0), sigma, 0.01)
        self.begun, self.one_unit = None, True
        self.asked = []
        self.sees_again = {}
        """Anchors that the two newest keyframes share with others."""

    def system(self):
        slam_map = SimpleNamespace(
            keyframes=self.keyframes,
            resolve=lambda k: (k, np.eye(4)),
            shared_counts=lambda anchors: self.sees_again if len(anchors) else {},
            piece_of=self.piece_of.__getitem__,
            lock=nullcontext(),
            pose_of=lambda k: se3.inverse(placed(self.keyframes[k].centre_w[0])),
            anchors=SimpleNamespace(p_w=np.array([[0.0, 0.0, 2.0], [5.0, 0.0, 2.0]])),
        )
        log = SimpleNamespace(
            records=[SimpleNamespace(keyframe_id=0), SimpleNamespace(keyframe_id=5)],
            replace=lambda *_: self.asked.append("moved"),
            support=lambda: SimpleNamespace(piece=np.zeros(2), supported=np.ones(2, dtype=bool)),
            poses=lambda: (np.zeros(2), np.stack([np.eye(4)] * 2)),
        )
        metres = ScaleEstimate(1.0, 0.02, "telemetry")
        graph = SubmapGraph(slam_map, log, lambda: metres)
        graph.begin(1, self.keyframes[5], self.between, 0.0, one_unit=self.one_unit)
        return SimpleNamespace(
            map=slam_map,
            graph=graph,
            tracker=SimpleNamespace(local_keyframes=lambda anchor: [self.keyframes[0]]),
            log=log,
            fusion=SimpleNamespace(predict=lambda stamp_s: self.predicted, begun=self.begun),
        )

    def finds(self, x, turned_deg=0.0):
        """Track of a candidate at ``(x, 0, 0)`` confirmed by earlier frames; None if it is rejected."""
        T_w_c = placed(x)
        T_w_c[:3, :3] = se3.exp(np.array([0, 0, 0, 0, 0, np.deg2rad(turned_deg)]))[:3, :3]
        track = SimpleNamespace(T_c_w=se3.inverse(T_w_c), anchor=np.array([0, 1]))
        found = SimpleNamespace(track=track, earlier=[1])
        state = SimpleNamespace(system=self.system(), relocaliser=SimpleNamespace(find=lambda *_: found))
        state._may_be_at = lambda *args: Tracking._may_be_at(state, *args)
        return Tracking.find(state, SimpleNamespace(index=7, stamp_s=6.0), None, [], None)


def test_relocalisation_out_of_reach_is_rejected():
    """2.5 units from the prediction after a path of five; the earlier frames keep their poses as well."""
    flown = Flown()
    assert flown.finds(2.5) is None and flown.asked == []


@pytest.mark.parametrize(("x", "sigma", "may"), [(4.7, 0.01, True), (4.5, 0.01, False), (4.5, 0.1, True)])
def test_the_gate_includes_drift_and_sensor_uncertainty(x, sigma, may):
    """One percent of the path, three of the depth, and the sensors' sigma: .08 and .13 units per axis."""
    assert (Flown(sigma).finds(x) is not None) == may


def test_the_gate_uses_the_shortest_covisibility_path():
    """After a long loop back to the start, similar wallpaper 1.3 m away is no match."""
    flown = Flown()
    for k in range(6):
        flown.keyframes[k].centre_w = np.array([10.0 * k if k < 5 else 5.0, 0.0, 0.0])
    assert flown.finds(3.7) is not None, "a path of 75 units"
    flown.sees_again = {0: 30}
    assert flown.finds(3.7) is None, "a path of 5"
    assert flown.finds(4.7) is not None


def test_the_shortest_path_continues_into_a_new_submap():
    """The same with a submap that begins there: its scale is uncertain, the path before it is not."""
    flown = Flown(between=0.01)
    flown.keyframes[4].centre_w = np.array([4.9, 0.0, 0.0])
    for k in range(1, 4):
        flown.keyframes[k].centre_w = np.array([10.0 * k, 0.0, 0.0])
    flown.piece_of[5] = 1
    assert flown.finds(3.7) is not None
    flown.sees_again = {0: 30}
    assert flown.finds(3.7) is None
    assert flown.finds(4.7) is not None


def test_relocalisation_with_a_wrong_heading_is_rejected():
    """Two sides of a room with the same shelves."""
    assert Flown().finds(5.0, turned_deg=15.0) is not None
    assert Flown().finds(5.0, turned_deg=90.0) is None


@pytest.mark.parametrize(("between", "may"), [(0.1, False), (0.5, True), (np.inf, True)])
def test_the_gate_includes_the_uncertainty_between_submaps(between, may):
    """A new submap after a loss; a candidate three metres away and rotated by a quarter turn."""
    flown = Flown(between=between)
    flown.piece_of[5] = 1
    assert (flown.finds(3.2) is not None) == may


@pytest.mark.parametrize(
    ("metres", "one_unit", "factor", "scale"),
    [
        (ScaleEstimate(1.0, 0.03, "telemetry"), True, 2.2, 1.0),
        (ScaleEstimate(1.0, 0.03, "telemetry"), True, 1.1, 1.025),
        (ScaleEstimate(1.0, 0.3, "telemetry"), True, 2.2, 2.15),
        (ScaleEstimate(1.0, 0.03, "imu"), False, 2.2, None),
        (ScaleEstimate(1.0, 0.03, "depth"), True, 2.2, None),
    ],
)
@pytest.mark.parametrize("between", [5.0, np.inf])
def test_a_link_does_not_double_a_submap_whose_unit_sensors_have_measured(between, metres, one_unit, factor, scale):
    """Whether or not sensors say where it begins; images alone have the scale where sensors have no common unit."""
    flown = Flown(between=between)
    flown.one_unit = one_unit
    flown.piece_of[5] = 1
    graph = flown.system().graph
    graph.scale_now = lambda: metres
    camera, none = flown.keyframes[5], np.zeros(0, np.int64)
    S = sim3.compose(factor, np.eye(3), (1.0 - factor) * camera.centre_w)
    belief = graph.between(camera, flown.keyframes[0], 2.0)
    assert belief is None or belief.allows(S, se3.inverse(placed(5.0))) or scale is not None
    if scale is not None:
        found = Link(camera, flown.keyframes[0], S, 0.02, none, none, 2.0).in_unit(belief.sigma_log)
        assert sim3.scale_of(found.S) == pytest.approx(scale, rel=0.02)
        # What counts makes the scale surer; what contradicts does not.
        assert (found.sigma_log < belief.sigma_log) == (scale != 1.0)
        there = (sim3.moved_camera(x, se3.inverse(placed(5.0))) for x in (S, found.S))
        np.testing.assert_allclose(*there, atol=1e-9)


@pytest.mark.parametrize(("between", "may"), [(0.1, False), (np.inf, True)])
def test_a_submap_that_has_no_map_yet_is_where_it_began(between, may):
    flown = Flown(between=between)
    flown.piece_of[5] = 1
    flown.predicted, flown.begun = None, flown.predicted
    assert (flown.finds(3.2) is not None) == may


def test_images_decide_without_related_sensors():
    """Without sensors, in an unrelated submap, and in the map of an earlier flight."""
    flown = Flown()
    flown.predicted = None
    assert flown.finds(0.0) is not None
    flown = Flown()
    flown.piece_of[5] = 1
    assert flown.finds(0.0) is not None
    assert Flown(earlier=True).finds(0.0) is not None
