"""The page of a live session: the fleet in 3-D, with buttons for orders, served by viser on this machine only."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from flockopt.errors import FlockError
from sim.live.drawing import FleetDrawing
from sim.live.picking import first_hit, typed_point
from sim.live.serving import HOST, local_server, stop_server
from sim.live.session import MOST_SPEED, Session
from sim.live.text import log_text, status_text, verdict_text
from sim.live.view import View

if TYPE_CHECKING:
    import viser

__all__ = ["Page"]

#: Seconds of flight between two drawings of the ways ahead.
WAYS_EVERY_S = 0.25

#: Speeds that can be chosen on the page, and strengths of gusts (m/s): least, most, step.
SPEEDS, GUSTS = (0.1, MOST_SPEED, 0.1), (0.5, 8.0, 0.5)

#: Added tasks hang this many times the room that a drone needs above what was clicked, if nobody moves the slider.
USUAL_HEIGHT = 4.0

NOTHING_OPEN = "none"


class Page:
    """A page that shows a session and passes orders on to it.

    Args:
        session: What it shows.
        port: Where it is served on this machine; the next free one if it is taken, any free one for 0.

    Raises:
        MissingExtra: If viser is not installed.
        SolverFailed: If viser cannot be held to this page alone.
    """

    def __init__(self, session: Session, port: int) -> None:
        self._session, self._scene = session, session.scene
        self.server: viser.ViserServer = local_server(port, "flockopt live")
        self._drawing = FleetDrawing(self.server, self._scene)
        self._ways_s, self._plan_number = -math.inf, -1
        gui = self.server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._status = gui.add_markdown("")
        self._add_clock()
        self._add_tasks()
        self._add_trouble()
        with gui.add_folder("Plan"):
            self._verdict = gui.add_markdown("")
        with gui.add_folder("Log"):
            self._log = gui.add_markdown("")

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop serving."""
        stop_server(self.server)

    def refresh(self) -> None:
        """Show how the session stands now."""
        view = self._session.view()
        with self.server.atomic():
            self._drawing.show(view)
            if view.plan_number != self._plan_number or view.now_s - self._ways_s >= WAYS_EVERY_S:
                self._drawing.show_ways(self._session.ways())
                self._plan_number, self._ways_s = view.plan_number, view.now_s
            self._write(view)

    def _write(self, view: View) -> None:
        """Bring the words up to date, and the tasks that can be withdrawn."""
        texts = ((self._status, status_text(view)), (self._verdict, verdict_text(view)), (self._log, log_text(view)))
        for handle, words in texts:
            if handle.content != words:
                handle.content = words
        choices = tuple(task.id for task in view.tasks if task.state != "served") or (NOTHING_OPEN,)
        if tuple(self._open_tasks.options) != choices:
            self._open_tasks.options = choices

    # -- orders ---------------------------------------------------------------------------------------------

    def _add_clock(self) -> None:
        gui, session = self.server.gui, self._session
        pause = gui.add_button("Pause or go on")
        speed = gui.add_slider("Speed", *SPEEDS, min(max(session.speed, SPEEDS[0]), SPEEDS[1]))

        def hasten(event: Any) -> None:
            session.speed = _slid(speed)
            speed.value = session.speed

        speed.on_update(_order(hasten))

        @pause.on_click
        def _(event: Any) -> None:
            session.is_paused = not session.is_paused

    def _add_tasks(self) -> None:
        gui, scene, session = self.server.gui, self._scene, self._session
        tall = scene.bounds.upper[2] - scene.bounds.lower[2]
        usual = min(USUAL_HEIGHT * (float(scene.radii.min()) + scene.clearance), 0.5 * tall)
        with gui.add_folder("Tasks"):
            by_click = gui.add_checkbox("A click in the scene adds one", True)
            height = gui.add_slider("so far above it, m", 0.0, tall, tall / 100.0, usual)
            place = gui.add_text("x, y, z", "")
            add = gui.add_button("Add a task there")
            self._open_tasks = gui.add_dropdown("open task", (NOTHING_OPEN,))
            withdraw = gui.add_button("Withdraw it")

        def clicked(event: Any) -> None:
            if by_click.value:
                x, y, z = first_hit(scene, event.ray_origin, event.ray_direction)
                session.add_task((x, y, round(z + _slid(height), 3)))

        self.server.scene.on_click()(_order(clicked))
        add.on_click(_order(lambda event: session.add_task(typed_point(place.value))))
        withdraw.on_click(_order(lambda event: session.remove_task(self._open_tasks.value)))

    def _add_trouble(self) -> None:
        gui, session = self.server.gui, self._session
        with gui.add_folder("Drones and wind"):
            drone = gui.add_dropdown("drone", tuple(drone.id for drone in self._scene.drones))
            kill = gui.add_button("Take it out of the air", color="red")
            strength = gui.add_slider("gust, m/s", *GUSTS, 3.0)
            gust = gui.add_button("Let it blow for 2 s")
        kill.on_click(_order(lambda event: session.kill(drone.value)))
        gust.on_click(_order(lambda event: session.blow((_slid(strength), 0.0, 0.0))))


def _slid(slider: viser.GuiSliderHandle[float]) -> float:
    """What a slider says, within its ends: it has a box to type in, and whoever speaks to the server may send anything."""
    return min(max(slider.value, slider.min), slider.max)


def _order(carry_out: Callable[[Any], object]) -> Callable[[Any], None]:
    """An order as a callback: what is refused is told to whoever gave it."""

    def callback(event: Any) -> None:
        try:
            carry_out(event)
        except FlockError as fault:
            if event.client is not None:
                event.client.add_notification("Refused", str(fault), color="red", auto_close_seconds=8.0)

    return callback
