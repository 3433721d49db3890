"""Rows of a plot: few, and the same ones while it scrolls; a stop that fails, or that others delay."""

import threading

import numpy as np
from helpers.browser_client import browser
from helpers.processes import until

from zstate.driving.driver_state import DriverStateListener, ReceivedState
from zstate.driving.messages import DriverState
from zstate.view.panels import html
from zstate.view.panels.control_panels import _DriverPanel, plotted_rows
from zstate.view.sliders import SliderCommander

S = 1_000_000_000


def test_plot_has_at_most_one_sample_for_each_of_its_intervals():
    stamps = 1_700_000_000 * S + np.arange(0, 10 * S, S // 1000)
    rows = plotted_rows(stamps)
    assert 240 <= len(rows) <= 241
    assert plotted_rows(stamps[::100]).tolist() == list(range(100))
    assert plotted_rows(stamps[:0]).tolist() == []


def test_consecutive_plots_choose_the_same_samples():
    stamps = 1_700_000_000 * S + np.arange(0, 12 * S, S // 997)
    first, second = stamps[:9970], stamps[123:10_093]
    before, after = set(first[plotted_rows(first)].tolist()), set(second[plotted_rows(second)].tolist())
    common = range(int(second[0]), int(first[-1]) + 1)
    # The first row of a plot may be in the middle of an interval.
    assert {one for one in after ^ before if one in common} <= {int(second[0])}


def test_failed_stop_is_shown_in_the_color_of_alarms_without_sliders(page, sessions):
    ready = DriverState(0, 5, "host", "ready", "", ("elbow",), 10**8)
    gui = page.server.gui
    with (
        DriverStateListener(sessions[0], "arm") as states,
        SliderCommander(sessions[0], "arm", states, lambda _: True) as commander,
    ):
        panel = _DriverPanel(gui, commander, gui.add_folder("Drivers"))
        commander.stop()  # of no driver
        assert "no driver" in commander.problem
        panel.update(ReceivedState(ready, 0.0))
        shown = html.paragraph(commander.problem, color=html.ALARM)
        assert shown in {getattr(handle, "content", "") for handle in vars(panel).values()}


def test_stop_button_works_while_clicks_of_a_browser_occupy_all_threads(page, sessions, host_driver):
    host = host_driver()
    gui = page.server.gui
    release, occupied = threading.Event(), threading.Semaphore(0)
    workers = gui._thread_executor._max_workers

    def occupy() -> None:
        occupied.release()
        release.wait(60.0)

    with (
        DriverStateListener(sessions[1], "arm") as states,
        SliderCommander(sessions[1], "arm", states, lambda _: True) as commander,
        browser(page) as mine,
    ):
        until(lambda: states.get("arm") is not None)
        _DriverPanel(gui, commander, gui.add_folder("Drivers"))
        *_, stop = [one for one in gui._gui_input_handle_from_uuid.values() if one.label == "STOP arm"]
        try:
            for _ in range(2 * workers):
                gui._thread_executor.submit(occupy)
            for _ in range(workers):
                assert occupied.acquire(timeout=60.0)
            until(page.server.get_clients)
            for _ in range(100):
                mine.update(stop, value=True)
            until(lambda: host.state == "stopped")
            assert not release.is_set()
        finally:
            release.set()
