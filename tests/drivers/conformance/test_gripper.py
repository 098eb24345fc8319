"""What every gripper keeps, simulated, emulated or real."""

from __future__ import annotations

import pytest

from drivers.interfaces import ConnectError, DeviceLostError, GripError, Gripper, LimitError


@pytest.fixture
def bench(gripper_bench):
    gripper_bench.gripper.connect()
    return gripper_bench


def test_is_a_gripper(gripper_bench) -> None:
    assert isinstance(gripper_bench.gripper, Gripper)
    assert gripper_bench.gripper.name


def test_grips_and_releases(bench) -> None:
    opened = bench.gripper.release()
    assert not opened.holding and not opened.moving
    gripped = bench.gripper.grip(bench.force_n)
    assert gripped.holding and not gripped.moving
    assert gripped.opening_m < opened.opening_m
    assert bench.gripper.state().holding
    released = bench.gripper.release()
    assert not released.holding and released.opening_m == pytest.approx(opened.opening_m, abs=1e-3)


def test_nothing_to_grip_is_an_error(bench) -> None:
    if bench.take_away is None:
        pytest.skip("this bench cannot empty the jaws")
    bench.take_away()
    with pytest.raises(GripError, match="nothing between the jaws") as error:
        bench.gripper.grip(bench.force_n)
    assert error.value.device == bench.gripper.name and error.value.remedy
    assert not bench.gripper.state().holding


@pytest.mark.parametrize("force_n", [0.0, -5.0, float("nan")])
def test_refuses_impossible_forces(bench, force_n) -> None:
    before = bench.gripper.state().opening_m
    with pytest.raises(LimitError):
        bench.gripper.grip(force_n)
    assert bench.gripper.state().opening_m == before


def test_a_cable_lost_while_holding_is_noticed(bench) -> None:
    if bench.slip is None:
        pytest.skip("this bench cannot pull the cable out")
    bench.gripper.grip(bench.force_n)
    bench.slip()
    bench.clock.sleep_s(0.3)
    assert not bench.gripper.state().holding


def test_closing_leaves_the_jaws_as_they_are(bench) -> None:
    bench.gripper.grip(bench.force_n)
    bench.gripper.close()
    bench.gripper.close()
    with pytest.raises(DeviceLostError):
        bench.gripper.state()
    bench.gripper.connect()
    assert bench.gripper.state().holding


def test_not_connected_is_an_error(gripper_bench) -> None:
    for act in (
        gripper_bench.gripper.release,
        lambda: gripper_bench.gripper.grip(gripper_bench.force_n),
    ):
        with pytest.raises(DeviceLostError):
            act()


def test_a_gripper_that_refuses_says_which_and_what_to_do(gripper_bench) -> None:
    if gripper_bench.refuse is None:
        pytest.skip("this bench cannot make its gripper refuse")
    gripper_bench.refuse()
    with pytest.raises(ConnectError) as error:
        gripper_bench.gripper.connect()
    assert error.value.device == gripper_bench.gripper.name
    assert error.value.remedy


def test_a_lost_gripper_is_an_error(bench) -> None:
    if bench.lose is None:
        pytest.skip("this bench cannot lose its gripper")
    bench.lose()
    with pytest.raises(DeviceLostError) as error:
        bench.gripper.state()
    assert error.value.device == bench.gripper.name and error.value.remedy
    bench.gripper.close()
