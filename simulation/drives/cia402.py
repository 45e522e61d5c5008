"""A simulated CiA 402 drive on a CANopen bus, based on the standards, independent of the master.

It is built from an EDS file and follows CiA 301 and CiA 402 literally; manufacturer-specific
choices are a `DriveBehaviour`. Set-points take effect and replies are sent at SYNC; a reply shows
the state at that SYNC, before the new set-point. Time advances only by `advance`. The drive has a
brake that is closed whenever there is no torque, so that its drum holds its position.

Source: CiA 301 (4.2), CiA 402-2.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from drivers.cia402.pdo import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    SDO_REPLY_BASE,
    NmtCommand,
    NmtState,
    make_emergency,
    make_heartbeat,
)
from drivers.cia402.profile import load_profile
from drivers.cia402.state_machine import DriveState
from model.files.drive_profile_file import ProfileDocument
from simulation.drives.behaviour import STRICT, DriveBehaviour
from simulation.drives.eds_file import Eds, Key, profile_path, read_eds
from simulation.drives.object_dictionary import (
    ACCELERATION_UNIT,
    HEARTBEAT_CONSUMERS,
    OUT_OF_RANGE,
    POSITION_UNIT,
    VELOCITY_UNIT,
    DriveObjects,
    SdoServer,
    counts_in,
    motion_settings,
)
from simulation.drives.pdo import (
    ACTING,
    CONTROL_WORD,
    MODE,
    PDO_OBJECTS,
    TARGET,
    TOLERANCE,
    TPDO,
    Deadlines,
    ProcessData,
    ReceivePdo,
)
from simulation.drives.power import MODE_FOLLOWS, TIMED, Motor, PowerStage

Frame = bytes | bytearray
Send = Callable[[int, Frame], None]

OPERATIONAL, BOOT_UP = NmtState.OPERATIONAL, NmtState.BOOT_UP

LIFE_GUARD = 0x8130
PDO_LATE = 0x8200
PDO_LENGTH = 0x8210
SET_POINT_OVERDUE = 0x8250
SYNC_OVERDUE = 0x8700

STATUS_WORD, MODE_DISPLAY, POSITION, TORQUE = (0x6041, 0), (0x6061, 0), (0x6064, 0), (0x6077, 0)
ERROR_REGISTER, ERROR_CODE = (0x1001, 0), (0x603F, 0)

_SYNC, _BOOT = "sync", "boot"

_FLICKERING = 0xEF90

_REGISTER_BITS = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10, 0xF: 0x80}
"""Bits of 1001h by the first digit of an error code: current, voltage, temperature, communication,
manufacturer-specific; each in addition to bit 0, generic error."""


class SimulatedDrive(PowerStage):
    """One drive and its motor.

    Attributes:
        node: CANopen node id.
        behaviour: What it does where the standards leave a choice.
        objects: Its object dictionary.
        motor: What it moves.
        nmt: NMT state.
        torque: Actual torque, set by the plant, [per mille of rated torque].
        silent: It neither receives nor sends, as with its bus cable unplugged (set from outside).
    """

    def __init__(
        self,
        node: int,
        position: float,
        top_speed: float,
        send: Send,
        *,
        eds: Eds | None = None,
        behaviour: DriveBehaviour = STRICT,
        counts_per_turn: float = 4096.0,
        profile: ProfileDocument | None = None,
    ) -> None:
        """Powers the drive on: it sends boot-up and waits in PRE-OPERATIONAL.

        Args:
            position: Of the motor, [counts].
            top_speed: Of the motor, [counts/s].
            send: Sends a frame (identifier, data).
            eds: Its objects (default: those of the profile ``cia402``).
            behaviour: Choices within the standards.
            counts_per_turn: Of the motor shaft, for drives with speed in revolutions.
            profile: Of its make (default: ``cia402``).
        """
        motor = Motor(position, position, top_speed, stick=behaviour.stick)
        super().__init__(motor, behaviour, seed=node)
        self._counts_per_turn, self._profile = counts_per_turn, profile or load_profile("cia402")
        self.node = node
        self._bus_send = send
        self._eds = eds or read_eds(profile_path("cia402"))
        self.silent = False
        self.power_on()

    def power_on(self) -> None:
        """Starts or restarts: the configuration is lost, the motor keeps its position."""
        self.objects = DriveObjects(self._eds, self.node, self.behaviour)
        for (index, sub), read in (
            (STATUS_WORD, self._status_shown),
            (MODE_DISPLAY, lambda: self._mode),
            (POSITION, self._position_shown),
            (TORQUE, self._torque_shown),
        ):
            self.objects.measured(index, sub, read)
        self._pdos = ProcessData(self.objects)
        self.objects.judge, self.objects.changed = self._judge, self._on_changed
        self._switch_on()
        self._boot()

    def _boot(self) -> None:
        """Boots after power-on or a reset of the communication."""
        self.nmt = NmtState.BOOT_UP
        self._server = SdoServer(self.objects, self.behaviour, self._answer)
        self._deadlines = Deadlines()
        self._read_settings()
        self._watched = self._heartbeat_consumers()
        self._waiting: dict[int, tuple[ReceivePdo, tuple[int, ...]]] = {}
        self._window_ends = inf
        self._errors: dict[object, int] = {}
        self._own_heartbeat_due = self._now
        if self.behaviour.boot_delay:
            self._deadlines.expect(_BOOT, self._now + self.behaviour.boot_delay)
        else:
            self._booted()

    def _booted(self) -> None:
        self.nmt = NmtState.PRE_OPERATIONAL
        if self.state is DriveState.NOT_READY:
            self.state = DriveState.SWITCH_ON_DISABLED
        self._send(HEARTBEAT_BASE + self.node, make_heartbeat(NmtState.BOOT_UP))

    def until_answer(self, with_mode: bool = False) -> float:
        """Time until the next answer, [s]; infinity if none is due.

        Args:
            with_mode: Also wait for a delayed mode.
        """
        if self.nmt is BOOT_UP or (with_mode and MODE_FOLLOWS in self._deadlines):
            due = min(self._deadlines.earliest, self._server.next_due)
        else:
            due = self._server.next_due
        return max(0.0, due - self._now)

    @property
    def pdo_ids(self) -> list[int]:
        """Identifiers of the valid RPDOs."""
        return list(self._pdos.received)

    def advance(self, elapsed: float) -> None:
        """Advances time, [s]: the motor moves, time-outs run, delayed frames are sent."""
        if elapsed <= 0.0:
            return
        now = self._now = self._now + elapsed
        self._move(elapsed)
        if self._motion.window < inf:
            self._check_following(elapsed)
        if self.behaviour.limits_monitored:
            self._check_limits()
        if now > self._deadlines.earliest:
            self._on_deadlines()
        if self._heartbeat_period and now >= self._own_heartbeat_due - TOLERANCE:
            self._own_heartbeat_due = now + self._heartbeat_period
            if self.nmt is not NmtState.BOOT_UP:
                self._send(HEARTBEAT_BASE + self.node, make_heartbeat(self.nmt))
        if now >= self._server.next_due - TOLERANCE:
            self._server.deliver(now)

    def on_sync(self) -> None:
        """SYNC: sends replies with the present state, then applies the waiting set-points.

        At a limit switch set-points are applied first and enable the drive, which then stops again.
        """
        if self.silent or self.nmt is not OPERATIONAL:
            return
        self._window_ends = self._now + self._sync_window if self._sync_window else inf
        if self._sync_timeout:
            self._deadlines.expect(_SYNC, self._now + self._sync_timeout)
            self._clear_error(_SYNC)
        if self.behaviour.flicker:
            self._flicker = self._random.getrandbits(16) & _FLICKERING
        is_at_switch = self._is_at_switch
        if is_at_switch:
            self._take_waiting()
        for pdo in self._pdos.sent:
            if pdo.is_due():
                self._send(pdo.can_id, pdo.form.pack(*[read() for read in pdo.readers]))
        self._take_waiting()
        if is_at_switch:
            self._stop_at_switch()

    def on_pdo(self, can_id: int, data: Frame) -> None:
        """An RPDO: unpacked by the current mapping, kept until the next SYNC if synchronous."""
        if self.silent or self.nmt is not OPERATIONAL:
            return
        pdo = self._pdos.received.get(can_id)
        if pdo is None:
            return
        if len(data) != pdo.form.size:
            self._raise_error((PDO_LENGTH, pdo.number), PDO_LENGTH)
            return
        if pdo.deadline:
            self._deadlines.expect(pdo.number, self._now + pdo.deadline)
        self._clear_error((PDO_LENGTH, pdo.number))
        self._clear_error(pdo.number)
        values = pdo.form.unpack(data)
        if pdo.synchronous:
            if self._now > self._window_ends + TOLERANCE:
                self._raise_error((PDO_LATE, pdo.number), PDO_LATE)
                return
            self._clear_error((PDO_LATE, pdo.number))
            self._waiting[pdo.number] = pdo, values
        else:
            self._take(pdo, values)

    def on_sdo(self, data: Frame) -> None:
        """An SDO request."""
        if self.silent or len(data) != 8 or self.nmt in (NmtState.STOPPED, NmtState.BOOT_UP):
            return
        self._server.on_request(bytes(data), self._now)

    def on_nmt(self, command: int, node: int) -> None:
        """An NMT command."""
        if self.silent or node not in (0, self.node) or self.nmt is NmtState.BOOT_UP:
            return
        if command == NmtCommand.START:
            self.nmt = NmtState.OPERATIONAL
        elif command == NmtCommand.PRE_OPERATIONAL:
            self._leave_operational(NmtState.PRE_OPERATIONAL)
        elif command == NmtCommand.STOP:
            self._leave_operational(NmtState.STOPPED)
            self._connection_lost(LIFE_GUARD)
        elif command == NmtCommand.RESET_NODE:
            self.power_on()
        elif command == NmtCommand.RESET_COMMUNICATION:
            self._connection_lost(LIFE_GUARD)
            self.objects.restore_communication()
            self._pdos.rebuild()
            self._boot()

    def on_heartbeat(self, node: int, data: Frame) -> None:
        """The heartbeat of another node; monitored from the first one."""
        if node not in self._watched or self.silent or self.nmt is BOOT_UP:
            return
        if len(data) == 1:
            self._deadlines.expect((LIFE_GUARD, node), self._now + self._watched[node])
            self._clear_error((LIFE_GUARD, node))

    def _judge(self, key: Key, value: int) -> int:
        """Abort code of an SDO write in the present state; 0 to accept it."""
        index = key[0]
        if index in PDO_OBJECTS:
            pre_operational = self.nmt is NmtState.PRE_OPERATIONAL
            may_map = pre_operational or self.behaviour.maps_when_operational
            return self._pdos.refused(key, value, may_map=may_map)
        if key == MODE and not self.objects.has_mode(value):
            return OUT_OF_RANGE
        if index in (POSITION_UNIT, VELOCITY_UNIT, ACCELERATION_UNIT):
            known = counts_in(value, self._counts_per_turn)
            return 0 if known and (index != POSITION_UNIT or known == 1.0) else OUT_OF_RANGE
        return 0

    def _on_changed(self, key: Key, value: int) -> None:
        """Reacts to a changed object."""
        index = key[0]
        if index in PDO_OBJECTS:
            if index in TPDO and key[1] == 1:  # no remote requests: bit 30 of the COB-ID
                self.objects.note(key, value & ~(1 << 30))
            self._pdos.rebuild()
            watched = {pdo.number for pdo in self._pdos.received.values() if pdo.deadline}
            for what in self._deadlines.kept():
                if isinstance(what, int) and what not in watched:
                    self._deadlines.forget(what)
        elif index == HEARTBEAT_CONSUMERS:
            self._watched = self._heartbeat_consumers()
            for what in self._deadlines.kept():
                if isinstance(what, tuple) and what[1] not in self._watched:
                    self._deadlines.forget(what)
                    self._errors.pop(what, None)
        elif key in (STATUS_WORD, MODE_DISPLAY, POSITION, TORQUE):
            self._pdos.rebuild()  # another reader
        elif key in ACTING:
            self._write(key, value)
        else:
            self._read_settings()

    def _read_settings(self) -> None:
        """Caches settings of time-outs, so that `advance` reads no objects."""
        self._motion = motion_settings(self.objects, self._counts_per_turn, self._profile)
        get = self.objects.get
        self._heartbeat_period = get((0x1017, 0), 0) / 1000.0
        monitored = get((0x1006, 0), 0) if self._profile.monitoring == "sync" else 0
        self._sync_timeout = self.behaviour.sync_periods * monitored / 1e6
        #: Of synchronous RPDOs after SYNC, [s]; 0: unlimited.
        self._sync_window = get((0x1007, 0), 0) / 1e6
        if not self._sync_timeout:
            self._deadlines.forget(_SYNC)

    def _heartbeat_consumers(self) -> dict[int, float]:
        """Nodes and times [s] of the heartbeat consumer, 1016h."""
        subs = self.objects.subs(HEARTBEAT_CONSUMERS)
        entries = (self.objects[HEARTBEAT_CONSUMERS, sub] for sub in subs if sub)
        room = self.objects.get((HEARTBEAT_CONSUMERS, 0), 0)
        taken = [e for e, _ in zip(entries, range(room), strict=False)]
        return {e >> 16 & 0x7F: (e & 0xFFFF) / 1000.0 for e in taken if e & 0xFFFF}

    def _on_deadlines(self) -> None:
        """Handles passed deadlines: missing messages, and timed events."""
        for what in self._deadlines.passed(self._now):
            if what == _BOOT:
                self._booted()
            elif what in TIMED:
                self._happens(what)
            elif what == _SYNC:
                self._raise_error(_SYNC, SYNC_OVERDUE)
                self._connection_lost(SYNC_OVERDUE)
            elif isinstance(what, int):
                self._raise_error(what, SET_POINT_OVERDUE)
                self._connection_lost(SET_POINT_OVERDUE)
            else:
                self._raise_error(what, LIFE_GUARD)
                self._lose_heartbeat()

    def _lose_heartbeat(self) -> None:
        """Loss of a heartbeat in 1016h: reaction by 6007h, and by 1029h:01 for the NMT state."""
        if self.behaviour.heartbeat_loss_is_fault:
            self._fault_code = LIFE_GUARD
            self._react_to_fault()
        else:
            self._connection_lost(LIFE_GUARD)
        option = self.objects.get((0x1029, 1), 0)
        if option == 2:
            self._leave_operational(NmtState.STOPPED)
        elif option == 0 and self.nmt is NmtState.OPERATIONAL:
            self._leave_operational(NmtState.PRE_OPERATIONAL)

    def _leave_operational(self, nmt: NmtState) -> None:
        """Stops process data and their monitoring."""
        self.nmt = nmt
        self._waiting.clear()
        for what in self._deadlines.kept():
            if what == _SYNC or isinstance(what, int):
                self._deadlines.forget(what)

    def _raise_error(self, what: object, code: int) -> None:
        """A communication error: reported once until it is cleared."""
        if what not in self._errors:
            self._errors[what] = code
            self._emergency(code)

    def _clear_error(self, what: object) -> None:
        """The error is over: EMCY 0000h, with the remaining error register."""
        if self._errors and self._errors.pop(what, None) is not None:
            self._emergency(0)

    def _take_waiting(self) -> None:
        """Applies the synchronous RPDOs received since the last SYNC."""
        waiting, self._waiting = self._waiting, {}
        for received, values in waiting.values():
            self._take(received, values)

    def _take(self, pdo: ReceivePdo, values: tuple[int, ...]) -> None:
        """Applies the data of an RPDO, the control word last, after the target."""
        self.objects.keep(pdo.keys, values)
        for at, key in pdo.acting:
            self._write(key, values[at])

    def _write(self, key: Key, value: int) -> None:
        """Writes an object that takes effect at once, by RPDO or SDO."""
        if key == TARGET:
            self._take_target(value)
        elif key == CONTROL_WORD:
            self._take_control_word(value)
        else:
            self._take_mode(value)

    def _emergency(self, code: int) -> None:
        """Sends EMCY: an error occurred (code), or one is over (0)."""
        active = [*self._errors.values(), self._fault_code, code]
        register = 0
        for one in active:
            if one:
                register |= 0x01 | _REGISTER_BITS.get(one >> 12, 0x20)
        if 0x8600 <= code < 0x8800:
            register |= 0x20  # device profile
        self.objects.note(ERROR_CODE, code or self._fault_code)
        self.objects.note(ERROR_REGISTER, register)
        if self.nmt in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL):
            self._send(EMCY_BASE + self.node, make_emergency(code, register))

    def _answer(self, data: bytes) -> None:
        if self.nmt is not NmtState.STOPPED:
            self._send(SDO_REPLY_BASE + self.node, data)

    def _send(self, can_id: int, data: Frame) -> None:
        if not self.silent:
            self._bus_send(can_id, data)
