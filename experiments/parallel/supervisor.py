"""The supervisor: simulates the vehicle in real time and monitors the other two processes."""

import multiprocessing
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack, closing

import numpy as np

from experiments.parallel.child_processes import (
    READY,
    Child,
    Stop,
    quiet,
    wait_until,
)
from experiments.parallel.control import control
from experiments.parallel.estimation import estimate
from experiments.parallel.mailbox import Mailbox, Message
from experiments.parallel.recording import Outcome, Recording
from experiments.parallel.setup import (
    COMMAND,
    ESTIMATE,
    MS,
    MS_PER_SECOND,
    SAMPLE,
    STALE_PERIODS,
    Setup,
)
from experiments.parallel.simulated_vehicle import Sensors, Vehicle, rehearse

START_TIMEOUT = 180.0
"""Time for both processes to import, and to compile if numba's cache is empty, s."""
LEAD = 50 * MS
"""Time from readiness to the first deadline, ns."""
SAMPLE_SLOTS = 64
"""Number of samples that can wait for a late estimator."""

Say = Callable[[str], None]


def run(setup: Setup, say: Say) -> Outcome:
    """Drive one run, printing through `say`; no process and no shared memory is left on return.

    Raises
    ------
    ValueError
        Outside of the main thread, the only one that handles signals.
    """
    with Stop() as stop, ExitStack() as resources:
        supervisor = Supervisor(setup, stop, resources)
        supervisor.start(say)
        return supervisor.drive()


class Supervisor:
    """Vehicle of one run, and the mailboxes and child processes, which `resources` removes."""

    def __init__(self, setup: Setup, stop: Stop, resources: ExitStack) -> None:
        self.setup, self._stop, self._resources = setup, stop, resources
        self._vehicle = Vehicle(setup)
        self._sensors = Sensors(setup.known_conditions, setup.fix_ms, setup.seed)
        self._recording = Recording()
        self._children: list[Child] = []
        self._fault = ""
        self._compiled: list[str] = []
        self._origin = 0
        self._sample = np.zeros((), SAMPLE)
        self._publish_times: list[int] = []
        """Time at which the sample of each control period was published, ns."""
        self._answered = -1
        """Number of the last control period with a command."""

    def start(self, say: Say) -> None:
        """Start both processes and wait until they are ready; keep a failure as the fault."""
        context = multiprocessing.get_context("spawn")
        samples, estimates, commands = (
            self._resources.enter_context(closing(Mailbox(dtype, slots=slots)))
            for dtype, slots in ((SAMPLE, SAMPLE_SLOTS), (ESTIMATE, 4), (COMMAND, 4))
        )
        self._samples = samples.writer.open()
        self._commands = commands.reader.open()
        self._estimates = self._resources.enter_context(estimates.passive_reader())
        for name, role, ends in (
            ("estimator", estimate, (samples.reader, estimates.writer)),
            ("controller", control, (estimates.reader, commands.writer)),
        ):
            child = Child(name, context, role, (self.setup, *ends))
            self._resources.callback(child.end)
            self._children.append(child)
        # Only the children hold these ends, so that each sees when the other is gone.
        for end in (samples.reader, estimates.writer, estimates.reader, commands.writer):
            end.close()
        rehearse(self.setup)  # while the children start
        if self._all_ready():
            names = [f"{child.name} {child.process.pid}" for child in self._children]
            say(f"processes: {', '.join(names)}; the clock runs")

    def _all_ready(self) -> bool:
        """Wait until both children are ready; return False on a fault or a signal."""

        def ready_or_dead() -> bool:
            return all(child.reported(READY) for child in self._children) or any(
                child.dead for child in self._children
            )

        if not wait_until(ready_or_dead, START_TIMEOUT, self._stop) and not self._stop.number:
            self._fault = f"the processes were not ready after {START_TIMEOUT:g} s"
        self._check_for_dead()
        return not self._fault and not self._stop.number

    def drive(self) -> Outcome:
        """Simulate the vehicle until time, path or a fault ends the drive; then stop everything."""
        end = ""
        if not self._fault and not self._stop.number:
            with quiet(self._compiled.append):
                end = self._loop()
        for child in self._children:
            child.request_stop()
        stopped = self._vehicle.stop()
        if self._stop.number:
            end = signal.Signals(self._stop.number).name
        return Outcome(
            end=end or "fault",
            fault=self._fault,
            signal=self._stop.number,
            recording=self._recording,
            stale_brakings=self._vehicle.stale_brakings,
            stop=stopped,
            final_speed=self._vehicle.speed,
            commands_refused=self._vehicle.commands_refused,
            compiled={
                name: place
                for name, place in (
                    ("vehicle", "".join(self._compiled)),
                    *((child.name, child.compiled) for child in self._children),
                )
                if place
            },
        )

    def _loop(self) -> str:
        """Run tick by tick: apply commands as they arrive, then advance and publish a sample."""
        setup, vehicle = self.setup, self._vehicle
        self._origin = time.monotonic_ns() + LEAD
        ms = 0
        while True:
            due = self._origin + ms * MS
            left = 1.0
            while left > 0.0:
                left = 1e-9 * (due - time.monotonic_ns())
                message = self._commands.wait(max(left, 0.0))
                if message is not None:
                    self._apply(message, ms)
            vehicle.advance(ms / MS_PER_SECOND)
            self._recording.lateness.append(1e-9 * (time.monotonic_ns() - due))
            self._recording.ages.append(vehicle.age)
            begins = ms % setup.period_ms == 0
            if begins:
                self._recording.note(vehicle)
                end = self._end(ms)
                if end:
                    return end
            self._publish(ms, due)
            if begins:
                self._keep_estimate()
                self._check_for_dead()
                self._check_for_hung()
            ms += setup.tick_ms

    def _end(self, ms: int) -> str:
        """Return why the drive ends at the beginning of this period, or ""."""
        if self._stop.number:
            return "signal"
        if self._vehicle.end is not None:
            return self._vehicle.end
        if self._fault and self._vehicle.braking is not None:
            return "fault"
        return "seconds" if ms >= MS_PER_SECOND * self.setup.seconds else ""

    def _apply(self, message: Message, tick_ms: int) -> None:
        """Give the vehicle a command at the time of its arrival, at the latest at the next tick."""
        value = message.value
        now = time.monotonic_ns()
        self._vehicle.advance(min(1e-9 * (now - self._origin), tick_ms / MS_PER_SECOND))
        due = int(value["due"])
        accepted = self._vehicle.take(
            float(value["acceleration"]), float(value["steering_angle"]),
            1e-9 * (due - self._origin),
        )  # fmt: skip
        if accepted:
            self._answered = int(value["period"])
            # The command takes effect with the vehicle's next cycle.
            applied = max(self._origin + round(1e9 * self._vehicle.time), now)
            self._recording.commands.append(
                (
                    int(value["period"]), 1e-9 * (applied - due),
                    1e-9 * (int(value["estimated"]) - due), 1e-9 * (message.stamp - due),
                    float(value["solve_time"]), int(value["reason"]), int(value["failures"]),
                )
            )  # fmt: skip

    def _publish(self, ms: int, due: int) -> None:
        sample, vehicle = self._sample, self._vehicle
        sample["period"] = ms // self.setup.period_ms
        sample["due"], sample["time"] = due, ms / MS_PER_SECOND
        sample["mean_acceleration"], sample["mean_steering_angle"] = vehicle.mean_inputs()
        sample["acceleration"], sample["steering_angle"] = vehicle.in_force
        state = vehicle.info["state"]
        sample["truth"] = state
        self._sensors.read(ms, state, sample)
        self._samples.put(sample)
        if ms % self.setup.period_ms == 0:
            self._publish_times.append(time.monotonic_ns())

    def _keep_estimate(self) -> None:
        message = self._estimates.latest()
        if message is not None:
            self._recording.estimates[int(message.value["period"])] = message.value

    def _check_for_dead(self) -> None:
        for child in self._children:
            if not self._fault and child.dead:
                self._fault = f"the {child.name} {child.how_it_ended()}"

    def _check_for_hung(self) -> None:
        """Set the fault if a process has left samples unanswered for too long.

        Time counts from the publication of a sample, so a vehicle that is itself late blames no
        other process.
        """
        if self._fault or self._vehicle.braking is None:
            return
        silence = self._silence(self._answered)
        if silence < self.setup.watchdog * self.setup.period:
            return
        estimate = self._estimates.latest()
        estimated = -1 if estimate is None else int(estimate.value["period"])
        working = self._silence(estimated) < (STALE_PERIODS + 1) * self.setup.period
        name, what = ("controller", "command") if working else ("estimator", "estimate")
        self._fault = f"the {name} hangs: no {what} for {silence:.2f} s"

    def _silence(self, answered: int) -> float:
        """Return how long the first sample after period `answered` has been waiting, s."""
        if answered + 1 >= len(self._publish_times):
            return 0.0
        return 1e-9 * (time.monotonic_ns() - self._publish_times[answered + 1])
