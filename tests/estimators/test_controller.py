"""The whole loop: it probes, servoes, notices that it has gone bad and recovers."""

import dataclasses

import numpy as np
import pytest
from kinematic_world import KinematicWorld, closed_loop, still_target

from servotrack.estimators.jacobian import (
    BroydenJacobian,
    DampedLeastSquares,
    Excitation,
    JacobianPrior,
    KalmanJacobian,
    LevelKalmanJacobian,
    OneStepExact,
    ParticleJacobian,
    Proportional,
    ProportionalIntegral,
    RandomWalk,
    RecursiveLeastSquares,
    ServoController,
    StudentTNoise,
    Supervisor,
    UnscentedJacobian,
)
from servotrack.estimators.stateful import select_rows

REACHABLE = still_target((0.6, 0.6))
ESTIMATORS = {
    "kf": KalmanJacobian(),
    "ukf": UnscentedJacobian(),
    "pf": ParticleJacobian(particles=200),
    "rls": RecursiveLeastSquares(),
    "broyden": BroydenJacobian(),
    "level-kf": LevelKalmanJacobian(),
    "student-t-kf": KalmanJacobian(outliers=StudentTNoise()),
}


@pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=ESTIMATORS)
def test_every_estimator_follows_the_papers_ellipse(estimator):
    errors = closed_loop(ServoController(estimator), KinematicWorld(rows=4, seed=1, pixel_noise=0.5))
    assert errors[:8].mean() > 0.1
    assert errors[-192:].mean() < 0.010


@pytest.mark.parametrize("law", [Proportional(), ProportionalIntegral(), DampedLeastSquares(), OneStepExact()])
def test_every_law_reaches_a_target_at_rest(law):
    world = KinematicWorld(target=REACHABLE, rows=3, seed=2, mounting=[0.0, 1.0, -2.5])
    errors = closed_loop(ServoController(KalmanJacobian(), law), world, steps=150)
    assert errors[-1].max() < 0.002


@pytest.mark.parametrize("latency", [1, 2])
def test_stamped_latency_costs_little(latency):
    errors = closed_loop(
        ServoController(KalmanJacobian()), KinematicWorld(rows=4, seed=3, pixel_noise=0.5, latency=latency)
    )
    assert errors[-192:].mean() < 0.015


def test_unscented_and_kalman_servo_alike_in_closed_loop():
    """With the settings of the paper' comparison: a learned J_theta(0), J_t(0) = 0."""
    world = KinematicWorld(warmup=0, max_joint_rate=5.0)
    world.reset()
    start = world.jacobian[0] * [1.0, 1.0, 0.0]
    prior = JacobianPrior(10.0, 10.0, tuple(map(tuple, start)))
    walk = RandomWalk(np.sqrt(31.6), np.sqrt(31.6))
    errors = [
        closed_loop(
            ServoController(
                make(walk=walk, measurement_noise=10.0, prior=prior),
                Proportional(gain=0.7),
                Excitation(steps=0),
                max_joint_rate=5.0,
            ),
            world,
        )
        for make in (KalmanJacobian, UnscentedJacobian)
    ]
    np.testing.assert_allclose(*errors, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("joints", [1, 2, 3, 6])
def test_the_exploratory_moves_show_every_column_and_lead_back(joints):
    excitation = Excitation(steps=2 * joints)
    direction = np.random.default_rng(4).choice([-1.0, 1.0], joints)
    moves = [excitation.rate(np.asarray(k), direction) * excitation.period for k in range(excitation.steps)]
    intervals = np.column_stack([np.array(moves), np.full(excitation.steps, excitation.period)])
    assert np.linalg.matrix_rank(intervals) == joints + 1
    np.testing.assert_allclose(np.sum(moves, axis=0), 0.0, atol=1e-12)
    assert np.abs(moves).max() == pytest.approx(excitation.amplitude)


def test_the_rate_is_limited_as_a_vector():
    law = Proportional(gain=1.0)
    world = KinematicWorld(target=REACHABLE)
    free = ServoController(KalmanJacobian(), law, max_joint_rate=1e6)
    limited = dataclasses.replace(free, max_joint_rate=0.5)
    measurement = world.reset()
    state = free.initial(measurement)
    for _ in range(9):
        before = state
        state, rate = free.step(state, measurement)
        slow = limited.step(before, measurement)[1]
        measurement = world.step(slow)
        assert np.abs(slow).max() <= 0.5 + 1e-12
        np.testing.assert_allclose(slow * np.abs(rate).max(), rate * np.abs(slow).max(), atol=1e-9)


def test_rows_can_be_started_anew_one_by_one():
    controller, world = ServoController(KalmanJacobian()), KinematicWorld(rows=3, seed=5, pixel_noise=0.5)
    measurement = world.reset()
    state = controller.initial(measurement)
    for _ in range(20):
        state, rate = controller.step(state, measurement)
        measurement = world.step(rate)
    mask = np.array([False, True, False])
    kept = controller.step(state, measurement)[1]
    mixed = controller.step(select_rows(mask, controller.initial(measurement), state), measurement)[1]
    np.testing.assert_array_equal(mixed[~mask], kept[~mask])
    np.testing.assert_allclose(mixed[1], [0.8, 0.0])


def wrong_jacobian(world):
    """A firm belief that every joint does the opposite of what it does."""
    world.reset()
    firm = JacobianPrior(joint_spread=5.0, time_spread=5.0, mean=tuple(map(tuple, -world.jacobian[0])))
    return KalmanJacobian(prior=firm, walk=RandomWalk(0.1, 0.1))


class _FreshStart(KalmanJacobian):
    """Forgets into a wide prior."""

    def forget(self, state):
        wide = dataclasses.replace(self, prior=JacobianPrior())
        return KalmanJacobian.forget(wide, state)


def test_a_wrong_jacobian_is_noticed_and_learned_anew():
    world = KinematicWorld(
        target=still_target((0.45, 0.62)), joint_low=(-3.0, -3.0), joint_high=(3.0, 3.0), image_size=1e6
    )
    belief = wrong_jacobian(world)
    estimator = _FreshStart(**{field.name: getattr(belief, field.name) for field in dataclasses.fields(belief)})
    unwatched = ServoController(estimator, excitation=Excitation(steps=0), supervisor=None)
    watched = ServoController(estimator, excitation=Excitation(steps=6), supervisor=Supervisor())
    assert closed_loop(unwatched, world, steps=60)[-1] > 0.1
    assert closed_loop(watched, world, steps=120)[-1] < 0.005


def measured(controller, world, steps, edit):
    """Closed loop with measurements changed by `edit(step, measurement)`; the joint rates of every step."""
    measurement = edit(0, world.reset())
    state = controller.initial(measurement)
    rates = []
    for k in range(steps):
        state, rate = controller.step(state, measurement)
        rates.append(rate)
        measurement = edit(k + 1, world.step(rate))
    return np.array(rates), state


def test_a_lost_target_sends_the_arm_back_to_where_it_was_seen():
    world = KinematicWorld(target=REACHABLE)
    seen = {}

    def blind(step, measurement):
        if step == 12:
            seen["joints"] = measurement.joint_angles.copy()
        if step <= 12:
            return measurement
        return measurement._replace(visible=np.zeros(1, bool))

    measured(ServoController(KalmanJacobian()), world, 40, blind)
    np.testing.assert_allclose(world.joints, seen["joints"], atol=1e-6)


def test_a_target_never_seen_does_not_move_the_arm_for_good():
    world = KinematicWorld(target=REACHABLE)
    blind = lambda step, measurement: measurement._replace(visible=np.zeros(1, bool))  # noqa: E731
    rates, _ = measured(ServoController(KalmanJacobian()), world, 60, blind)
    assert np.isfinite(rates).all()
    assert np.abs(world.joints - world.start).max() < 0.2


def test_a_joint_at_its_stop_is_noticed():
    """The first joint sits at its stop and is told to go on: the loop probes, away from the stop first."""
    world = KinematicWorld(target=REACHABLE, start=(-0.3, 1.2), joint_low=(-0.3, 0.0), joint_high=(1.5, 3.1))
    world.reset()
    firm = JacobianPrior(
        joint_spread=1.0, time_spread=1.0, mean=tuple(map(tuple, world.jacobian[0] * [-1.0, 1.0, 1.0]))
    )
    estimator = KalmanJacobian(prior=firm, walk=RandomWalk(0.01, 0.01))
    probing = ServoController(estimator, excitation=Excitation(steps=4))
    measurement = world.reset()
    state = probing.initial(measurement)
    state = state._replace(excitation=state.excitation._replace(move=np.array([4])))
    moved_away = False
    for _ in range(40):
        state, rate = probing.step(state, measurement)
        if state.excitation.move[0] == 1:
            moved_away = bool(rate[0, 0] > 0)
            break
        measurement = world.step(rate)
    assert moved_away


def test_a_good_loop_is_left_alone():
    controller = ServoController(KalmanJacobian())
    world = KinematicWorld(rows=8, seed=6, pixel_noise=1.0, drop_rate=0.1)
    moves = []
    measurement = world.reset()
    state = controller.initial(measurement)
    for _ in range(260):
        state, rate = controller.step(state, measurement)
        measurement = world.step(rate)
        moves.append(state.excitation.move.copy())
    assert (np.array(moves)[6:] == 6).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ServoController(KalmanJacobian(), max_joint_rate=0.0), "max_joint_rate"),
        (lambda: Excitation(steps=-1), "steps"),
        (lambda: Excitation(amplitude=0.0), "amplitude"),
        (lambda: Supervisor(symptom_limit=0), "symptom_limit"),
        (lambda: Supervisor(nis_memory=1.0), "nis_memory"),
    ],
)
def test_impossible_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
