"""The study: its directory, its budget, and the order in which points are measured."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable
from pathlib import Path
from time import monotonic

from warpflag.base.device import list_devices
from warpflag.base.output import OutputError
from warpflag.base.progress import bar
from warpflag.base.streams import is_terminal, say, tell
from warpflag.record import RECORD_NAME, Record
from warpflag.run.lock import SWEEP_NAME, Lock
from warpflag.run.run_directory import COURSE_NAME, SCENE_NAME, SUMMARY_NAME, RunError, check_same_scene, write_whole
from warpflag.run.simulation import Simulation
from warpflag.run.tradeoff import choices, compared, plot, points, report, windows
from warpflag.run.tradeoff.choices import REFERENCE
from warpflag.scene import Scene, SceneError, dumps

__all__ = ["Study"]

_POINTS = "points"
_COURSE_SHARE = 0.25  # of the budget, at most, goes into the coarse run
_REFERENCE_SHARE = 0.3  # and into the references of all windows
_REFERENCES = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4)  # accuracies, the finest that there is time for [um/ms]
_FINER = 3.0  # a reference is finer than what it judges by at least this


class _OutOfTime(Exception):
    """The budget is spent in the middle of a point."""


class Study:
    """What accuracy costs on a scene.

    Args:
        scene: of the user.
        output: directory; None: runs/NAME-tradeoff. A study of the same scene there is continued.
        device: to run on.
        record: run directory of this scene whose course is taken; None: a coarse run finds it.

    Raises:
        DeviceError: there is no such device.
        LockedError: another process works there.
        RunError: the directory holds the study of another scene, or a run.
        SceneError: the scene can't be simulated.
    """

    def __init__(self, scene: Scene, output: str | None, device: str | None, record: str | None = None) -> None:
        if scene.fluid.temperature:
            problem = "must be 0 for a trade-off: paths with thermal noise have nothing to converge to"
            raise SceneError("fluid.temperature", scene.fluid.temperature, problem)
        Simulation(scene, device=device)  # refuses what can't be simulated, before anything is written
        self._scene, self._device, self._record = scene, device, record
        self.directory = Path(output or f"runs/{scene.name}-tradeoff")
        for taken, what in ((RECORD_NAME, "run"), (SUMMARY_NAME, "run"), (SWEEP_NAME, "sweep")):
            if (self.directory / taken).exists():
                raise RunError(f"-o {self.directory}: holds a {what}; name another -o")
        try:
            (self.directory / _POINTS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"-o {self.directory}: can't be made: {error.strerror}") from None
        self._points: dict[tuple[str, str], points.Point] = {}
        self._unstartable: dict[str, str] = {}  # windows whose reference can't begin with their shape, and why
        self._lock = Lock(self.directory)
        try:
            self._open()
        except BaseException:
            self._lock.release()
            raise

    def _open(self) -> None:
        """Reads what the directory holds."""
        if (self.directory / SCENE_NAME).exists():
            check_same_scene(self.directory, self._scene)
        else:
            write_whole(self.directory / SCENE_NAME, dumps(self._scene))
        for path in sorted((self.directory / _POINTS).glob("*.npz")):
            if (point := points.load(path)) is None:
                path.unlink()
                tell(f"{path}: can't be read, and is measured again")
            else:
                self._points[point.window, point.choice] = point
        if self._points and not (self.directory / COURSE_NAME).exists():
            problem = f"has points, but no {COURSE_NAME} that says where their windows are; remove it"
            raise RunError(f"-o {self.directory}: {problem}, or name another -o")

    @property
    def stopped(self) -> bool:
        """Whether guards have stopped the reference of every window that was begun."""
        references = [point for point in self._points.values() if point.choice == REFERENCE]
        return bool(references) and all(point.status != "done" for point in references)

    def execute(self, budget: float, quiet: bool = False, check: Callable[[], None] = lambda: None) -> str:
        """Measures for so many seconds of wall time; returns the report.

        Args:
            budget: [s]; what begins within it is cut at its end, what is compiled is not.
            quiet: no progress.
            check: called a few times a second; what it raises ends the study, which can be continued.
        """
        try:
            self._measure(monotonic() + budget, budget, _Line(quiet), check)
        finally:
            self._lock.release()
        return self._told()

    def _measure(self, deadline: float, budget: float, line: _Line, check: Callable[[], None]) -> None:
        try:
            course = self._course(monotonic() + _COURSE_SHARE * budget, line, check)
            plan = self._plan(course, deadline)
            waiting = [step for step in plan if (step[0].name, step[1].name) not in self._points]
            for window, choice in waiting:
                done = len(plan) - len(waiting) + waiting.index((window, choice))
                line.show(done, len(plan), f"{window.name}: {choice.name}", deadline - monotonic())
                left = deadline - monotonic()
                if left <= 0.0:
                    break
                if self._is_comparable(window, choice) and self._expected(choice, course) < left:
                    self._take(course, window, choice, deadline, check)
        except _OutOfTime:
            pass
        finally:
            line.close()

    def _course(self, until: float, line: _Line, check: Callable[[], None]) -> windows.Course:
        path = self.directory / COURSE_NAME
        if path.exists():
            return windows.load(path)
        if self._record is not None:
            with Record(self._record) as record:
                course = windows.found_in_record(self._scene, record)
        else:

            def told(share: float) -> None:
                check()
                line.show(int(100 * share), 100, "course of the scene", until - monotonic())

            course = windows.found_by_run(self._scene, self._device, lambda: monotonic() > until, told)
        windows.save(course, path)
        return course

    def _plan(self, course: windows.Course, deadline: float) -> list[tuple[windows.Window, choices.Choice]]:
        """All points in the order of their turns; in each window the reference comes first."""
        others = [] if self._device not in (None, "cpu") else [d.split()[0] for d in list_devices()[1:]]
        finest = self._reference_accuracy(course, deadline)
        own = [
            c
            for c in choices.choices_of(self._scene, others)
            if c.values.get("numerics.accuracy", 1.0) > _FINER * finest
        ]
        reference = choices.reference(finest)
        # The latest window first: with little time, what lasts longest of a run is known.
        order = sorted(course.windows, key=lambda window: -window.time)
        found = []
        for turn in sorted({choice.turn for choice in own}):
            for window in order:
                if turn == own[0].turn:
                    found.append((window, reference))
                found += [(window, choice) for choice in own if choice.turn == turn]
        return found

    def _reference_accuracy(self, course: windows.Course, deadline: float) -> float:
        """The finest accuracy for which there is time, from a first coarse point [um/ms]."""
        for point in self._points.values():
            if point.choice == REFERENCE:
                return float(point.settings["accuracy"])
        window, coarse = course.windows[-1], choices.reference(5e-3)
        try:
            began = monotonic()
            points.measured(self._scene, course, window, coarse, self._device, self._watch(deadline, lambda: None))
            taken = monotonic() - began
        except SceneError:
            return _REFERENCES[0]
        allowed = _REFERENCE_SHARE * (deadline - monotonic()) / len(course.windows)
        for accuracy in _REFERENCES:
            if taken * choices.relative_cost(choices.reference(accuracy), self._scene) < allowed:
                return accuracy
        return _REFERENCES[-1]

    def _is_comparable(self, window: windows.Window, choice: choices.Choice) -> bool:
        """Whether the window has a reference that came to its end, or this is to be it."""
        reference = self._points.get((window.name, REFERENCE))
        return choice.name == REFERENCE or (reference is not None and reference.status == "done")

    def _expected(self, choice: choices.Choice, course: windows.Course) -> float:
        """Seconds that a point takes, by what others took; compiling is not foreseen."""
        costs = []
        for point in self._points.values():
            accuracy, implicit = point.settings.get("accuracy"), point.settings["stepper"] == "implicit"
            if point.status == "done" and accuracy and point.source == "time step" and implicit:
                own = choices.reference(float(accuracy))
                costs.append(point.cost * course.length / choices.relative_cost(own, self._scene))
        return choices.relative_cost(choice, self._scene) * min(costs) if costs else 0.0

    def _take(
        self,
        course: windows.Course,
        window: windows.Window,
        choice: choices.Choice,
        deadline: float,
        check: Callable[[], None],
    ) -> None:
        try:
            point = points.measured(self._scene, course, window, choice, self._device, self._watch(deadline, check))
        except SceneError as error:  # a shape that this choice can't start from
            if choice.name == REFERENCE:
                self._unstartable[window.name] = str(error)
            return
        paths = (self.directory / _POINTS / f"{number:04d}.npz" for number in itertools.count())
        points.save(point, next(path for path in paths if not path.exists()))
        self._points[window.name, choice.name] = point

    def _watch(self, deadline: float, check: Callable[[], None]) -> Callable[[], None]:
        def look() -> None:
            check()
            if monotonic() > deadline:
                raise _OutOfTime

        return look

    def _told(self) -> str:
        """Writes table and figure of what has been measured; returns the report."""
        path = self.directory / COURSE_NAME
        rows = compared.compared(list(self._points.values()))
        if not path.exists() or not rows:
            return f"{self.directory}: the budget was too short for any point; run it again to go on"
        course = windows.load(path)
        found = compared.summaries(rows, course.length)
        report.write_csv(rows, course, self.directory / report.CSV_NAME)
        made = [report.CSV_NAME]
        try:
            plot.draw(found, self._scene.name, self.directory / plot.FIGURE_NAME)
            made.append(plot.FIGURE_NAME)
        except OutputError as error:
            made.append(f"no figure: {error}")
        count = len(self._points)
        written = f"{count} point{'s'[: count != 1]}: {self.directory}: {', '.join(made)}"
        return report.text(rows, found, course, self._unstartable) + "\n" + written


class _Line:
    """The progress of a study: a bar on a terminal, a line per tenth elsewhere."""

    def __init__(self, quiet: bool) -> None:
        self._quiet, self._bar, self._tenth = quiet, None, -1

    def show(self, done: int, count: int, what: str, left: float) -> None:
        said = f"{what}, {max(0, math.ceil(left))} s left"
        if self._quiet:
            return
        if is_terminal(sys.stderr):
            if self._bar is None or self._bar.total != count:
                self.close()
                self._bar = bar(count, "{n:.0f} of {total:.0f} |{bar}| {desc}")
            self._bar.n = done
            self._bar.set_description_str(said)
        elif int(10 * done / max(count, 1)) != self._tenth:
            self._tenth = int(10 * done / max(count, 1))
            self._quiet = not say(f"{done:3d} of {count}  {said}\n")

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
