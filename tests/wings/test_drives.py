"""Both ends of a virtual CAN bus: the controller's drives, from finding them to moving them, and what happens
when something fails."""

import os
import sys
import threading

import numpy as np
import pytest
from benches import BusBench, Springs, own_bus

from fastrod.errors import InputError
from fastrod_device.can.bus import open_bus
from fastrod_device.can.clock import SteppedClock, WallClock
from fastrod_device.can.dictionary import object_dictionary
from fastrod_device.can.drive import DriveBus
from fastrod_device.can.faultcodes import CODES, STATUS_BITS, in_words, state_in_words
from fastrod_device.can.pacer import Pacer, urgently
from fastrod_device.emulator.nodes import EmulatedDrives
from fastrod_device.errors import DeviceError
from fastrod_device.units import DriveSpec, Transmission

canopen = pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")

SPECS = [DriveSpec(node=k + 1, drum_radius=0.008, direction=(1, -1)[k % 2]) for k in range(4)]
COUNT = SPECS[0].metres_per_count
SLACK = np.array([1e-3, 2e-3, 0.5e-3, 1.5e-3])  # m
STIFFNESS = 2000.0  # N/m
TENDONS = Springs(STIFFNESS, SLACK)
OFF, ENABLED, STOPPED, FAULT = "switch on disabled", "operation enabled", "quick stop active", "fault"


def bench(clock=None, specs=SPECS, **options):
    return BusBench(specs, TENDONS, clock, **options)


@pytest.fixture
def connected():
    with bench() as made:
        made.bus.connect()
        yield made


@pytest.fixture
def ready(connected):
    """Connected and enabled."""
    connected.bus.enable()
    return connected


def states(feedback):
    return [state_in_words(int(word)) for word in feedback.statusword]


def emergencies(seen):
    return [(e.drive, e.code) for feedback in seen for e in feedback.emergencies]


# the whole story


def test_connect_leaves_the_drives_operational_and_switched_off(connected):
    newest = connected.bus.newest
    assert (newest.nmt.tolist(), states(newest), newest.lost) == ([5] * 4, [OFF] * 4, "")


def test_the_greatest_torque_is_written_as_a_current_and_kept():
    with bench() as made:
        made.bus.connect(torque_limit=np.array([150, 300, 200, 250]))
        assert made.held(0x3001, 2) == [323, 645, 430, 538]  # thousandths of 54 mN m by 25.1 mN m/A [mA]
        made.bus.connect()
        assert made.held(0x3001, 2) == [6454] * 4
        with pytest.raises(InputError, match=r"torque_limit is \[70000, .*below 2\^16"):
            made.bus.connect(torque_limit=70_000)


def test_a_tendon_is_pulled_no_harder_than_the_greatest_torque_allows():
    with bench() as made:
        made.bus.connect(torque_limit=60, following_error=200_000)
        made.bus.enable()
        for k in range(150):
            seen = made.run(1, np.array([100, -100, 100, -100]) * k)[0]
        # 60 thousandths are 129.08 mA, which are written as 129 [N]
        most = 129.0 / 129.08 * Transmission(SPECS).tension(np.array([60, -60, 60, -60]))
        tension = STIFFNESS * (made.nodes.true_pulled - SLACK)
        assert np.all(np.abs(seen.following_error) > 5000)
        # it is known once in a cycle: 10,000 counts/s x 584 nm x 2000 N/m x 10 ms
        assert np.all((tension >= most) & (tension < most + 0.13))
        assert np.all(np.abs(seen.torque) < 65)  # with its noise


def test_process_data_cannot_be_requested_and_what_is_unused_is_invalid():
    with bench() as made:
        for node in made.nodes._nodes:  # somebody had stored PDOs of his own
            for index in (0x1401, 0x1403, 0x1802):
                node.objects.values[(index, 1)] &= 0x3FFF_FFFF
        made.bus.connect()
        for k, node in enumerate(made.nodes._nodes, 1):
            indices = [*range(0x1400, 0x1404), *range(0x1800, 0x1804)]
            held = {index: node.objects.values[(index, 1)] for index in indices}
            assert (held[0x1400], held[0x1800], held[0x1801]) == (0x200 + k, 0x4000_0180 + k, 0x4000_0280 + k)
            unused = [held[index] >> 30 for index in (0x1401, 0x1402, 0x1403, 0x1802, 0x1803)]
            assert unused == [0b10, 0b10, 0b10, 0b11, 0b11]
            assert [held[index] & 0x7FF for index in (0x1401, 0x1802)] == [0x300 + k, 0x380 + k]


def test_pdos_that_the_dictionary_lacks_are_left_alone(tmp_path):
    dictionary, own = object_dictionary(), tmp_path / "own.eds"
    for index in (0x1402, 0x1403, 0x1803):
        del dictionary[index]
    canopen.export_od(dictionary, str(own))
    with bench(own=own) as made:
        made.bus.connect()
        assert (made.bus.newest.nmt.tolist(), made.nodes.states) == ([5] * 4, (OFF,) * 4)


def test_enabling_does_not_move_a_drive(ready):
    before = ready.nodes.true_pulled
    assert states(ready.run(20)[-1]) == [ENABLED] * 4
    np.testing.assert_array_equal(ready.nodes.true_pulled, before)


def test_a_ramp_of_set_points_is_followed_with_a_lag(ready):
    speed = 5000  # counts/s
    seen = [ready.run(1, np.full(4, round(speed * k / 100.0)))[0] for k in range(100)]
    assert np.ptp([f.velocity for f in seen[50:]]) <= 0.02 * speed
    assert seen[-1].velocity == pytest.approx(np.full(4, speed), rel=0.01)
    # the drive interpolates over one period; its position loop lags by 3 ms, less the substep of 1 ms that it
    # has looked ahead
    assert seen[-1].following_error == pytest.approx(np.full(4, speed * 2e-3), abs=1)
    np.testing.assert_array_equal(ready.run(10)[-1].position, np.full(4, round(speed * 99 / 100.0)))


def test_counts_are_tendon_by_the_drums_and_their_directions(ready):
    dl = np.array([-0.5e-3, 0.3e-3, -0.2e-3, 0.1e-3])
    ready.run(30, Transmission(SPECS).counts(dl))
    # negative change of length = pulled in
    np.testing.assert_allclose(ready.nodes.true_pulled, -dl, atol=1e-6)


def test_no_sdo_in_the_loop_and_no_set_point_is_missed(ready):
    requested, served = ready.bus.sdo_requests, ready.nodes.sdo_served
    ready.bus.reset_statistics()
    ready.run(300, np.zeros(4, dtype=int))
    assert requested > 100  # setting up took some
    assert (ready.bus.sdo_requests, ready.nodes.sdo_served) == (requested, served)
    assert (ready.nodes.missed_setpoints, ready.bus.missed) == (0, 0)


def test_homing_ends_where_each_tendon_is_taut(ready):
    threshold = Transmission(SPECS).torque(np.full(4, 2.0))
    end = ready.bus.homing(np.abs(threshold), 4000, rounds=1)
    np.testing.assert_array_equal(end.position, np.zeros(4))
    tension = STIFFNESS * (ready.nodes.true_pulled - SLACK)
    # the torque is looked at once a cycle: 4000 counts/s x 584 nm x 2000 N/m x 10 ms
    assert np.all((tension > 1.8) & (tension < 2.0 + 4000 * COUNT * STIFFNESS * 0.01 + 0.2))
    assert states(end) == [ENABLED] * 4
    # noise of thousandths
    said = Transmission(SPECS).tension(end.torque)
    np.testing.assert_allclose(said, tension, atol=4 * 1.2e-4 * SPECS[0].newtons_per_torque)


@pytest.mark.study
def test_homing_then_goes_to_its_offset(ready):
    offset = np.array([-300, 300, -200, 100])  # lets out where growing counts pull
    end = ready.bus.homing(np.full(4, 100), 4000, offset=offset, rounds=1, order=[2, 0, 3, 1])
    np.testing.assert_allclose(end.position, offset, atol=1)


def test_homing_of_a_tendon_that_never_gets_taut_stops_the_drives(ready):
    with pytest.raises(DeviceError, match=r"find the tendon of node 1 taut within 0\.5 s"):
        ready.bus.homing(np.full(4, 900), 1000, time_limit=0.5)
    assert ready.bus.stop_reason == "homing did not end"
    assert states(ready.run(5)[-1]) == [STOPPED] * 4


def test_a_profile_move_arrives_and_takes_its_time(connected):
    bus, goal = connected.bus, np.array([4000, -4000, 2000, 0])
    bus.enable("ppm")
    began = connected.clock.now()
    end = bus.profile_move(goal, velocity=10_000.0, acceleration=100_000.0)
    # trapezoid: distance / velocity + velocity / acceleration = 0.5 s
    assert connected.clock.now() - began == pytest.approx(0.5, abs=0.1)
    np.testing.assert_allclose(end.position, goal, atol=2)
    again = bus.profile_move(np.zeros(4, dtype=int), velocity=20_000.0, acceleration=100_000.0)
    np.testing.assert_allclose(again.position, 0, atol=2)


def test_close_leaves_the_drives_off_and_says_no_emergency(ready):
    ready.bus.close()
    assert (ready.nodes.states, ready.bus.emergency_log) == ((OFF,) * 4, ())


@pytest.mark.real_time
def test_the_same_story_in_real_time():
    with bench(WallClock()) as made:
        made.bus.connect()
        made.bus.enable()
        seen = made.run(30, np.full(4, 200))
        assert states(seen[-1]) == [ENABLED] * 4
        np.testing.assert_allclose(seen[-1].position, 200, atol=2)
        made.bus.quick_stop()
        assert states(made.run(10)[-1]) == [STOPPED] * 4
        assert made.bus.jitter.n > 20


# stopping


def test_quick_stop_stays_latched_until_it_is_acknowledged(ready):
    ready.run(20, np.full(4, 100))
    ready.bus.quick_stop("somebody pressed the button")
    stopped = ready.run(30, np.full(4, 5000))[-1]
    assert states(stopped) == [STOPPED] * 4
    assert np.all(np.abs(stopped.position - 100) < 50)
    with pytest.raises(DeviceError, match="somebody pressed the button"):
        ready.bus.enable()
    ready.bus.acknowledge()
    assert states(ready.run(5)[-1]) == [STOPPED] * 4  # acknowledging alone moves nothing
    ready.bus.enable()
    before = ready.bus.newest.position
    assert ready.bus.stop_reason == ""
    np.testing.assert_array_equal(ready.run(20)[-1].position, before)  # the old target is forgotten


def test_a_quick_stop_brakes_along_its_ramp():
    with bench() as made:
        made.bus.connect(deceleration=200_000)
        made.bus.enable()
        speed = 20_000
        for k in range(60):
            made.run(1, np.full(4, round(speed * k / 100.0)))
        at, moving = made.bus.newest.position, made.nodes.moving
        made.bus.quick_stop()
        ran = made.run(40)[-1].position - at
        assert moving.all()
        assert not made.nodes.moving.any()
        # speed^2 / (2 deceleration) = 1000 counts, and one cycle until it is known
        assert np.all((ran > 950) & (ran < 1000 + 1.5 * speed / 100.0))


@pytest.mark.real_time
def test_quick_stop_from_another_thread_interrupts_a_move():
    with bench(WallClock()) as made:
        made.bus.connect()
        made.bus.enable("ppm")
        timer = threading.Timer(0.2, made.bus.quick_stop)
        timer.start()
        with pytest.raises(DeviceError, match=r"were stopped \(quick stop was asked for\)"):
            made.bus.profile_move(np.full(4, 100_000), velocity=10_000.0, acceleration=100_000.0)
        timer.join()
        made.run(10)
        assert not made.nodes.moving.any()
        assert np.all(made.nodes.true_pulled < 20_000 * COUNT)


def test_quick_stop_raises_nothing_on_a_bus_that_is_gone(ready):
    ready.bus.close()
    ready.bus.quick_stop()
    assert ready.bus.stop_reason == "quick stop was asked for"


def test_a_controller_that_pauses_finds_its_drives_stopped_and_leaves_them_so(ready):
    ready.run(10, np.zeros(4, dtype=int))
    ready.clock.sleep_until(ready.clock.now() + 0.5)
    seen = ready.run(10, np.full(4, 300))
    assert ready.bus.stop_reason.startswith("the controller paused for 0.5")
    assert states(seen[-1]) == [STOPPED] * 4
    assert {code for _, code in emergencies(seen)} == {0x8130}
    np.testing.assert_array_equal(seen[-1].position, np.zeros(4))


# faults, each as the controller sees it


def test_a_lost_heartbeat_ages(ready):
    ready.nodes.lose_heartbeat(2)
    last = ready.run(30)[-1]
    assert last.heartbeat_age[2] > 0.2
    assert np.all(np.delete(last.heartbeat_age, 2) < 0.06)
    assert np.all(last.age < 0.02)


FAULTS = {
    "over-voltage": (lambda nodes: nodes.emergency(1, 0x3210), (1, 0x3210)),
    "encoder jump beyond the window": (lambda nodes: nodes.encoder_jump(1, -5000), (1, 0x8611)),
    "blocked shaft": (lambda nodes: nodes.block(0), (0, 0x8611)),  # a following error
}


@pytest.mark.parametrize("name", FAULTS)
def test_an_emergency_names_its_drive_and_code_once(name, ready):
    inject, (drive, code) = FAULTS[name]
    inject(ready.nodes)
    seen = [ready.run(1, np.full(4, 100 * k if drive == 0 else 0))[0] for k in range(60)]
    assert emergencies(seen) == [(drive, code)]
    assert states(seen[-1]) == [FAULT if k == drive else ENABLED for k in range(4)]
    if name == "blocked shaft":
        assert max(f.following_error[0] for f in seen) > 1800
        assert seen[-1].position[0] == 0


def test_a_bus_that_is_off_says_so_and_stops_the_drives(ready):
    ready.nodes.bus_off()
    last = ready.run(20, np.zeros(4, dtype=int))[-1]
    assert "no drive has said anything" in last.lost
    assert np.all(last.age > 0.1)
    ready.nodes.restore()
    back = ready.run(20, np.zeros(4, dtype=int))[-1]
    assert (back.lost, states(back)) == ("", [STOPPED] * 4)  # by themselves, for want of a heartbeat


def test_a_bus_that_cannot_send_is_lost_without_an_exception(ready):
    ready.bus._line.bus.shutdown()
    assert ready.run()[0].lost.startswith("nothing can be sent: ")


def test_a_reboot_never_enables_again(ready):
    ready.run(10, np.full(4, 500))
    ready.nodes.reboot(3)
    last = ready.run(60, np.full(4, 500))[-1]
    assert (last.nmt[3], ready.nodes.states[3]) == (0, OFF)
    assert last.age[3] > 0.5
    with pytest.raises(DeviceError, match=r"nodes \[4\] are not connected, or have rebooted"):
        ready.bus.enable()
    ready.bus.connect()
    ready.bus.enable()
    again = ready.run(5)[-1]
    assert states(again) == [ENABLED] * 4
    assert (again.position[3], again.position[0]) == (0, 500)  # the counter of one began anew


def test_an_encoder_jump_is_seen_and_the_drive_moves_the_tendon_by_it(ready):
    before = ready.run(5)[-1].position
    ready.nodes.encoder_jump(2, 1500)
    jumped = ready.run()[0].position - before
    assert 1000 < jumped[2] < 1500  # its position loop is at work already
    assert not np.delete(jumped, 2).any()
    np.testing.assert_allclose(ready.run(30)[-1].position, before, atol=1)
    np.testing.assert_allclose(ready.nodes.true_pulled, [0, 0, -1500 * COUNT, 0], atol=1e-6)


@pytest.mark.parametrize("foreign", [1, 5, 40])
@pytest.mark.study
def test_answers_to_another_nodes_sync_do_not_pass_for_those_to_ours(ready, foreign):
    import can

    other = open_bus(ready.name)
    for k in range(20):  # a loop that ran ahead of its drives would leave frames behind
        for _ in range(foreign):
            other.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        seen = ready.run(1, np.full(4, 50 * k))[0]
        assert (seen.foreign_syncs, ready.nodes._line.bus.queue.qsize()) == (foreign, 0)
    other.shutdown()
    assert np.all(seen.position > 850)
    assert ready.run()[0].foreign_syncs == 0


def test_a_bus_that_hears_itself_takes_its_own_sync_for_nobody_elses():
    import can

    name, clock = own_bus(), SteppedClock()
    channel = name.removeprefix("virtual:")
    with (
        can.Bus(interface="virtual", channel=channel, receive_own_messages=True) as echoing,
        open_bus(name) as other,
        EmulatedDrives(SPECS, name, clock=clock, tendons=TENDONS),
        DriveBus(SPECS, echoing, clock=clock, rate=100.0) as bus,
    ):
        bus.connect()
        assert sum(bus.exchange().foreign_syncs for _ in range(20)) == 0
        for _ in range(3):
            other.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        assert sum(bus.exchange().foreign_syncs for _ in range(5)) == 3


def test_a_silent_drive_ages_and_is_heard_again(ready):
    ready.bus.reset_statistics()
    ready.nodes.silent(1)
    last = ready.run(10)[-1]
    assert (ready.bus.missed, last.lost) == (10, "")
    assert last.age[1] > 0.08
    assert np.all(np.delete(last.age, 1) < 0.02)
    ready.nodes.restore()
    assert np.all(ready.run(4)[-1].age < 0.02)


def test_faults_are_reset_only_when_requested_and_nothing_is_enabled_by_it(ready):
    ready.nodes.emergency(0, 0x2310)
    ready.nodes.emergency(2, 0x4210, lasting=True)
    assert states(ready.run(20)[-1])[::2] == [FAULT, FAULT]
    with pytest.raises(DeviceError, match="node 1 is in fault: over-current"):
        ready.bus.enable()
    with pytest.raises(DeviceError, match=r"node 3 stays in fault: power stage too hot \(0x4210\)"):
        ready.bus.reset_faults()
    assert ready.nodes.states[0] == OFF
    ready.nodes.restore()
    ready.bus.reset_faults()
    assert states(ready.run(20)[-1])[::2] == [OFF, OFF]
    ready.bus.enable()
    assert states(ready.run()[0]) == [ENABLED] * 4


def test_a_drive_that_is_not_there_is_named():
    with bench(specs=SPECS[:1], expected=SPECS[:2]) as made:
        with pytest.raises(DeviceError, match="the drive at node 2 does not answer"):
            made.bus.connect()
        with pytest.raises(DeviceError, match="not connected"):
            made.bus.enable()


def test_a_motor_of_another_rated_torque_is_refused():
    other = [DriveSpec(node=1, drum_radius=0.008, rated_torque=0.1)]
    with (
        bench(specs=SPECS[:1], expected=other) as made,
        pytest.raises(DeviceError, match=r"rated torque is 0\.054 N m"),
    ):
        made.bus.connect()


def test_an_own_dictionary_takes_the_place_of_ours(tmp_path):
    own, dictionary = tmp_path / "own.eds", object_dictionary()
    canopen.export_od(dictionary, str(own))
    assert len(object_dictionary(own)) == len(dictionary)


# words and units


@pytest.mark.parametrize("state", STATUS_BITS)
def test_states_and_their_statuswords(state):
    assert state_in_words(STATUS_BITS[state]) == state
    assert state_in_words(STATUS_BITS[state] | 0x9610) == state  # voltage, remote, target reached, ...


def test_codes_in_words():
    assert all(in_words(code).startswith(words) for code, words in CODES.items())
    assert in_words(0x8199) == "communication (0x8199)"
    assert in_words(0xEE00) == "unknown error (0xEE00)"


def test_counts_and_torques_go_round():
    transmission = Transmission(SPECS)
    dl, tension = np.array([-3e-3, 2e-3, 0.0, 1e-3]), np.array([0.5, 1.0, 2.0, 5.0])
    np.testing.assert_allclose(transmission.dl(transmission.counts(dl)), dl, atol=0.5 * COUNT)
    one = 1e-3 * SPECS[0].rated_torque * SPECS[0].newtons_per_torque
    np.testing.assert_allclose(transmission.tension(transmission.torque(tension)), tension, atol=0.5 * one)
    # one rotation of the drum: gear x counts, and its circumference
    whole = transmission.dl(np.array([21 * 4096, -21 * 4096, 0, 0]))
    np.testing.assert_allclose(whole[:2], [-2 * np.pi * 0.008, -2 * np.pi * 0.008], rtol=1e-12)


# the pacer


def test_a_pacer_keeps_to_multiples_and_skips_what_is_past():
    clock, times = SteppedClock(), []
    pacer = Pacer(clock, 100.0)
    for k in range(5):
        assert pacer.wait() == 0.0
        times.append(clock.now())
        if k == 2:
            clock.sleep_until(clock.now() + 0.034)
            assert pacer.wait() == pytest.approx(0.004)  # at once
    assert times == pytest.approx([0.01, 0.02, 0.03, 0.07, 0.08])
    assert pacer.slipped == 2


@pytest.mark.skipif(sys.platform != "linux", reason="urgency is Linux's")
def test_only_what_is_started_urgently_is_urgent():
    def policy():
        seen.append(os.sched_getscheduler(0))

    seen, before = [], os.sched_getscheduler(0)
    with urgently():
        inside = threading.Thread(target=policy)
        inside.start()
        inside.join()
    assert os.sched_getscheduler(0) == before
    with urgently(False):
        policy()
    assert seen[0] in (os.SCHED_FIFO, before)  # granted, or not
    assert seen[1] == before
