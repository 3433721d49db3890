"""The invariant filter: propagation, updates and contacts, against derivatives and closed forms."""

import numpy as np
import pytest
from helpers.filter_states import derivative, log_so3, moved, moved_pose, small_error, some_state
from helpers.imu_simulation import SimulatedBody, mean_band

from zstate import InvalidInput
from zstate.odometry import invariant_filter as iekf
from zstate.odometry import measurements
from zstate.odometry.invariant_filter import FilterState, Floats, ImuNoise
from zstate.odometry.rotations import rotation_exp

NOISE = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
SILENT = ImuNoise(gyro=1e-200, accel=1e-200, gyro_bias=0.0, accel_bias=0.0)
RATE, FORCE = np.array([0.7, -1.2, 0.9]), np.array([2.0, -1.0, 9.0])


def transition_of(state: FilterState, dt_s: float) -> Floats:
    """The transition F, read from F P F^T: e_i e_8^T becomes F e_i e_8^T, as height moves nothing else."""
    unit = np.eye(len(state.covariance))
    columns = [
        iekf.predict(state._replace(covariance=np.outer(row, unit[8])), RATE, FORCE, dt_s, SILENT).covariance[
            :, 8
        ]
        for row in unit
    ]
    return np.array(columns).T


@pytest.mark.parametrize("dt_s", [0.1, 0.005])
def test_the_transition_is_the_derivative_of_the_motion_by_the_error(dt_s: float):
    state = some_state()
    after = iekf.predict(state, RATE, FORCE, dt_s, NOISE)
    expected = derivative(
        lambda error: small_error(iekf.predict(moved(state, error), RATE, FORCE, dt_s, NOISE), after),
        len(state.covariance),
    )
    difference = transition_of(state, dt_s) - expected
    # What a gyro bias does to velocity and position in the step has its mean rotation and force only. With
    # their first derivatives, R' and s', the velocity has dt^3 / 12 ([s'] R - [s] R') more.
    bound = dt_s**3 / 12.0 * 2.0 * float(np.linalg.norm(RATE) * np.linalg.norm(FORCE))
    assert np.abs(difference[3:9, 9:12]).max() < bound
    difference[3:9, 9:12] = 0.0
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)


def test_the_noise_of_a_long_step_is_that_of_many_short_ones():
    long = some_state()._replace(covariance=np.zeros((21, 21)))
    short = long
    long = iekf.predict(long, RATE, FORCE, 0.1, NOISE, contact_noise=0.01)
    for _ in range(100):
        short = iekf.predict(short, RATE, FORCE, 0.001, NOISE, contact_noise=0.01)
    np.testing.assert_allclose(long.position, short.position, atol=1e-12)
    np.testing.assert_allclose(long.rotation, short.rotation, atol=1e-12)
    scale = np.sqrt(np.diag(short.covariance))
    # Correlations with the walks of biases inside the step are cut off, of the order of the step.
    difference = (long.covariance - short.covariance) / np.outer(scale, scale)
    np.testing.assert_allclose(difference[:9, :9], 0.0, atol=0.01)
    np.testing.assert_allclose(np.diag(difference), 0.0, atol=0.01)


def measured_run(body: SimulatedBody, steps: int) -> FilterState:
    """A run with the velocity of a turned and offset frame at 1/5 of the steps, and six positions in all."""
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = rotation_exp(np.array([0.1, -0.3, 1.2])), (0.3, -0.1, 0.2)
    velocity_sigmas, position_sigma = np.array([0.03, 0.05, 0.05]), 0.2
    state = body.first_estimate()
    for step in range(1, steps + 1):
        gyro, accel = body.step()
        state = iekf.predict(state, gyro, accel, body.dt_s, NOISE)
        if step % 5 == 0:
            at_frame = body.rotation.T @ body.velocity + np.cross(body.rate, mount[:3, 3])
            linear = mount[:3, :3].T @ at_frame + body.rng.normal(size=3) * velocity_sigmas
            rate = body.rate + body.gyro_bias  # without noise, which would be one with that of the prediction
            measurement = measurements.body_velocity(state, linear, np.diag(velocity_sigmas**2), mount, rate)
            state = iekf.updated(state, measurement)
        if step % (steps // 6) == 0:
            point = body.position + body.rotation @ mount[:3, 3] + body.rng.normal(size=3) * position_sigma
            fix = measurements.position(state, point, np.eye(3) * position_sigma**2, mount)
            state = iekf.updated(state, fix)
    return state


@pytest.mark.long
@pytest.mark.parametrize("runs", [15, pytest.param(100, marks=pytest.mark.soak)])
def test_errors_of_many_runs_are_as_large_as_the_covariance_states(runs: int):
    bodies = [SimulatedBody(seed, dt_s=0.02) for seed in range(runs)]
    nees = np.array([body.nees(measured_run(body, 180)) for body in bodies])
    low, high = mean_band(runs=runs, freedom=3)
    assert ((low < nees.mean(axis=0)) & (nees.mean(axis=0) < high)).all(), nees.mean(axis=0)


@pytest.mark.parametrize("pitch_rate", [1.5, -1.5])
def test_a_body_that_pitches_over_and_over_keeps_its_attitude(pitch_rate: float):
    # 12 rad in all: four times through a right angle, up or down.
    bodies = [SimulatedBody(seed, dt_s=0.02, pitch_rate=pitch_rate) for seed in range(4)]
    nees = np.array([body.nees(measured_run(body, 400)) for body in bodies])
    # 99.99 % of the chi-square distribution of three degrees of freedom are below 21.1.
    assert nees.max() < 21.1


def test_a_covariance_stays_positive_definite_through_sharp_measurements():
    state = some_state()
    for _ in range(500):
        sharp = measurements.position(state, state.position, np.eye(3) * 1e-8, np.eye(4))
        state = iekf.updated(iekf.predict(state, RATE, FORCE, 0.005, NOISE), sharp)
    np.testing.assert_array_equal(state.covariance, state.covariance.T)
    assert np.linalg.eigvalsh(state.covariance)[0] > 0.0
    np.testing.assert_allclose(state.rotation.T @ state.rotation, np.eye(3), atol=1e-14)


def test_an_update_is_the_weighted_mean_of_estimate_and_measurement():
    state = iekf.initial_state(
        rotation=np.eye(3),
        velocity=np.zeros(3),
        position=np.array([1.0, 2.0, 3.0]),
        gyro_bias=np.zeros(3),
        accel_bias=np.zeros(3),
        covariance=np.diag(np.repeat([1e-9, 1.0, 4.0, 1.0, 1.0], 3)),
    )
    measurement = measurements.position(state, np.array([6.0, 2.0, 3.0]), np.eye(3), np.eye(4))
    outcome = iekf.innovation(state, measurement)
    # Variances 4 and 1: the sum is that of the innovation, and the estimate moves by 4/5 of 5 m.
    np.testing.assert_allclose(outcome.covariance, np.eye(3) * 5.0, rtol=1e-6)
    assert outcome.nis == pytest.approx(25.0 / 5.0)
    after = iekf.updated(state, measurement)
    np.testing.assert_allclose(after.position, [5.0, 2.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(iekf.plain_covariance(after)[6:9, 6:9], np.eye(3) * 0.8, atol=1e-6)


def test_a_new_contact_has_the_error_of_the_position_and_of_its_offset():
    state, offset, covariance = some_state(), np.array([0.2, 0.1, -0.5]), np.diag([1e-4, 4e-4, 9e-4])
    grown = iekf.with_contact(state, "new", offset, covariance)
    assert grown.feet == ("foot0", "foot1", "new")
    # Truth c = p + R (offset - noise): measured with the same offset, the error is that noise alone.
    measured = iekf.innovation(grown, measurements.contact(grown, "new", offset, np.zeros((3, 3))))
    np.testing.assert_allclose(measured.residual, 0.0, atol=1e-12)
    np.testing.assert_allclose(measured.covariance, covariance, atol=1e-12)
    left = iekf.without_contact(grown, "foot0")
    assert left.feet == ("foot1", "new")
    np.testing.assert_array_equal(left.contacts, grown.contacts[1:])
    kept = [*range(15), *range(18, 24)]
    np.testing.assert_array_equal(left.covariance, grown.covariance[np.ix_(kept, kept)])


def displacement(way: tuple[float, float, float]) -> Floats:
    moved_by = np.eye(4)
    moved_by[:3, :3] = rotation_exp(np.array([0.2, -0.1, 0.6]))
    moved_by[:3, 3] = way
    return moved_by


def test_a_pose_that_is_carried_on_has_the_error_that_it_had_and_that_of_the_displacement():
    """By its definition: the truth is ``exp(error) moved`` from the true pose, at the true scale."""
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = rotation_exp(np.array([0.4, -1.1, 2.0])), (0.3, -0.2, 0.5)
    state = iekf.with_tracked(some_state(), "camera", 0.1)
    # The state has the velocity of that way in 0.5 s, so that an error of the scale is one along it.
    way = mount[:3, :3].T @ state.rotation.T @ state.velocity * 0.5
    moved_by, walk = displacement((way[0], way[1], way[2])), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-4
    size = len(state.covariance)
    after = iekf.carried(state, "camera", moved_by, walk, mount, dt_s=0.5)

    def error_of(error: Floats, noise: Floats) -> Floats:
        twist = moved_pose(iekf.Tracked("", moved_by[:3, :3], moved_by[:3, 3], 0.0), np.append(noise, 0.0))
        true_move = np.eye(4)
        true_move[:3, :3], true_move[:3, 3] = twist.rotation, twist.position
        truth = iekf.carried(moved(state, error), "camera", true_move, walk, mount, dt_s=0.5).tracked[0]
        turn = truth.rotation @ after.tracked[0].rotation.T
        return np.concatenate((log_so3(turn), truth.position - turn @ after.tracked[0].position))

    by_error = derivative(lambda error: error_of(error, np.zeros(6)), size)
    by_noise = derivative(lambda noise: error_of(np.zeros(size), noise), 6)
    expected = by_error @ state.covariance @ by_error.T + by_noise @ walk @ by_noise.T
    np.testing.assert_allclose(after.covariance[15:21, 15:21], expected, atol=1e-9)
    np.testing.assert_allclose(after.covariance[:15, 15:21], (state.covariance @ by_error.T)[:15], atol=1e-9)
    np.testing.assert_array_equal(after.covariance[:15, :15], state.covariance[:15, :15])


def test_poses_by_other_odometries_and_contacts_have_their_own_places_in_the_covariance():
    state = some_state()
    grown = iekf.with_tracked(iekf.with_tracked(state, "camera", 0.1), "lidar", 0.2)
    kept = [*range(15), *range(29, 35)]
    np.testing.assert_array_equal(grown.covariance[np.ix_(kept, kept)], state.covariance)
    assert [grown.covariance[row, row] for row in (21, 28)] == pytest.approx([0.01, 0.04])
    # At first such a pose has the error of the state.
    same = [*range(3), *range(6, 9)]
    np.testing.assert_array_equal(grown.covariance[22:28, :15], state.covariance[same, :15])
    offset = np.array([0.2, 0.1, -0.5])
    stood = iekf.without_contact(iekf.with_contact(grown, "new", offset, np.eye(3)), "foot0")
    measured = iekf.innovation(stood, measurements.contact(stood, "new", offset, np.zeros((3, 3))))
    np.testing.assert_allclose(measured.covariance, np.eye(3), atol=1e-12)
    after = iekf.predict(stood, RATE, FORCE, 0.01, NOISE, contact_noise=0.1)
    assert after.tracked == stood.tracked
    np.testing.assert_array_equal(after.covariance[15:29, 15:29], stood.covariance[15:29, 15:29])
    np.testing.assert_array_equal(iekf.without_tracked(grown).covariance, state.covariance)


def test_contacts_that_are_not_there_are_refused_by_name():
    state = some_state()
    with pytest.raises(InvalidInput, match="'foot0' is in contact already"):
        iekf.with_contact(state, "foot0", np.zeros(3), np.eye(3))
    with pytest.raises(InvalidInput, match="'tail' is not in contact; in contact are: foot0, foot1"):
        iekf.without_contact(state, "tail")


@pytest.mark.parametrize("changed", [{"gyro": 0.0}, {"accel": -1.0}, {"gyro_bias": np.nan}])
def test_noise_that_cannot_be_is_refused_by_name(changed: dict[str, float]):
    densities = {"gyro": 1e-3, "accel": 1e-2, "gyro_bias": 1e-5, "accel_bias": 1e-4}
    with pytest.raises(InvalidInput, match=repr(next(iter(changed)))):
        ImuNoise(**{**densities, **changed})
