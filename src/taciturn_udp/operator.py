"""The set-points and manual inputs of an operator, sent to a running controller, which reports what is in effect.

An operator knows the address of the controller and the key of the link ``setpoint``, but not the policy. So the
exchange begins with a challenge, whose answer contains all that the operator needs:

1. The operator sends a challenge with a random number, with the fingerprint and the link of no policy. The controller
   answers with this number, the fingerprint of its policy, the number of the link, its present step, and the last epoch
   in which an operator has given set-points. A report follows, with as many numbers as there are set-points.
2. The operator sends the set-points, in an epoch of his own, which is later than the last one, and sends them again
   until a report confirms them. With a key, the controller first challenges the operator, as any other sender.
3. After each step before which it has received set-points, the controller reports the set-points that it has received,
   those that are in effect, within their range and ramp, and the epoch and number of the newest packet.

Manual inputs, and the return to automatic operation, are sent and repeated in the same way, and numbered together with
the set-points. With each report, the controller tells its mode, and thereby the number of its inputs, unless it cannot
be operated by hand.

An answer repeats the random number, and a report the epoch and number of a packet, so that recorded ones are useless.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from taciturn.errors import ProblemError
from taciturn.extend import number_of
from taciturn.model.packets import operator_shapes
from taciturn.model.wire import ANY_LINK, ANY_POLICY, HEADER_SIZE, KINDS, OFFSETS, SETPOINT, PacketKind, fits
from taciturn.nodes.keys import Keys
from taciturn.nodes.packet import Frames, Packet
from taciturn_udp.endpoint import Address
from taciturn_udp.proofs import answer_to
from taciturn_udp.service import Port

AGAIN = 0.2  # seconds after which a packet without an answer is sent again
PATIENT = 10.0  # seconds until the operator gives up
ASKED = 3  # times that the operator asks whether the controller can be operated by hand
FOLLOWED = 2  # steps whose set-points are compared, to tell a ramp from a range


class InEffect(NamedTuple):
    """Set-points of a controller, as it reports them."""

    step: int  # the step from which these set-points are in effect
    given: tuple[float, ...]  # set-points that the controller has received
    in_effect: tuple[float, ...]  # set-points within their range and ramp
    moves: bool = False  # whether they move on to those that were given
    manual: tuple[float, ...] | None = None  # manual inputs; None: automatic

    def sentence(self) -> str:
        """Return the set-points in effect, and why they are not those that were given, if so."""
        by_hand = "" if self.manual is None else f"manual input {_text(self.manual)}, "
        found = f"{by_hand}set-point {_text(self.in_effect)} in effect from step {self.step}"
        if self.given == self.in_effect:
            return found
        why = "on the ramp towards" if self.moves else "at the end of the range, instead of"
        return f"{found}, {why} {_text(self.given)}"


class Operator:
    """An operator of one controller, at the address ``to``, with the key of the link ``setpoint``.

    Without a given ``epoch``, it is the system time in seconds, or follows the last one, if this is later. The operator
    gives up after ``patience`` seconds.
    """

    def __init__(
        self,
        port: Port,
        to: Address,
        keys: Keys | None = None,
        epoch: int | None = None,
        patience: float = PATIENT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start without knowledge of the controller."""
        if keys is not None:
            keys.check("operator", [SETPOINT])
        self._port, self._to, self._keys, self._patience, self._clock = port, to, keys, patience, clock
        self._place = f"{to[0]}:{to[1]}"
        self._asked, self._stated, self._epoch = epoch, epoch, 0
        self._policy: tuple[int, int] | None = None  # fingerprint of the policy, and number of the link
        self._nonce = 0
        self._sequence, self._tick, self._size = -1, 0, 0
        self._inputs = 0  # number of inputs of the plant; 0: not known
        self._manual: tuple[float, ...] | None = None

    def ask(self) -> InEffect:
        """Return the present set-points of the controller."""
        self._nonce = secrets.randbits(64)
        asks = Frames(ANY_POLICY, {ANY_LINK: SETPOINT}, {}, self._keys)
        hello = asks.encode(Packet("challenge", SETPOINT, 0, 0, nonce=self._nonce))
        self._policy = None
        for packet in self._until_answered(lambda: hello):
            if packet.kind == "answer":
                last = packet.epoch
                if self._asked is not None and self._asked <= last:
                    raise ProblemError(
                        f"--epoch is {self._asked}, but the controller at {self._place} has received set-points of "
                        f"the epoch {last}; expected a larger number, or no --epoch"
                    )
                self._epoch = self._asked or max(int(time.time()), last + 1)
                self._sequence = -1
            if packet.kind == "report" and self._policy is not None:
                return self._report(packet)
        key = "without a key" if self._keys is None else f"with the same key of the link {SETPOINT!r}"
        raise ProblemError(
            f"nobody answers at {self._place} within {self._patience:g} s; expected a running controller {key}, whose "
            "set-points may change (add [reference] with range or ramp to its problem file, also for manual inputs)"
        )

    def give(self, values: Sequence[float]) -> InEffect:
        """Give the controller set-points, and return those in effect after its next step."""
        if self._policy is None:
            self.ask()
        if len(values) != self._size or not fits(values):
            raise ProblemError(
                f"the set-points are {list(values)}; expected {number_of(self._size, 'finite number')}, as the "
                f"controller at {self._place} has {number_of(self._size, 'set-point')}"
            )
        self._sequence += 1
        first: InEffect | None = None
        for packet in self._until_answered(lambda: self._encoded("setpoint", tuple(values))):
            if packet.kind != "report" or not self._confirms(packet):
                continue
            found = self._report(packet)
            if found.given == found.in_effect:
                return found
            if first is not None and found.step >= first.step + FOLLOWED - 1:
                return found._replace(moves=found.in_effect != first.in_effect)
            first = first or found
        if first is not None:
            return first._replace(moves=True)
        raise self._not_confirmed("the set-points")

    def operate(self, values: Sequence[float] | None) -> InEffect:
        """Give the controller manual inputs, or None for automatic operation; return what is in effect after its next
        step.
        """
        for _ in range(ASKED):  # the packet that states the number of inputs may be lost
            if self._policy is None or not self._inputs:
                self.ask()
        if not self._inputs:
            raise ProblemError(
                f"the controller at {self._place} cannot be operated by hand; expected a policy whose actuators apply "
                "the command of a linear controller"
            )
        if values is not None and (len(values) != self._inputs or not fits(values)):
            raise ProblemError(
                f"the manual input is {list(values)}; expected {number_of(self._inputs, 'finite number')}, one for "
                "each input of the plant"
            )
        payload = (0.0,) * (1 + self._inputs) if values is None else (1.0, *map(float, values))
        self._sequence += 1
        for packet in self._until_answered(lambda: self._encoded("manual", payload)):
            told = self._manual == (None if values is None else payload[1:])
            if packet.kind == "report" and self._confirms(packet) and told:
                return self._report(packet)
        raise self._not_confirmed("the manual input" if values is not None else "automatic operation")

    def _not_confirmed(self, what: str) -> ProblemError:
        return ProblemError(
            f"the controller at {self._place} has not confirmed {what} within {self._patience:g} s; expected a "
            "controller that executes steps: is its plant running, and is a step shorter than --wait?"
        )

    def _confirms(self, packet: Packet) -> bool:
        """Return whether a report is on the newest packet of this operator; begin a later epoch if another one has."""
        if packet.epoch > self._epoch and self._stated is None:  # another operator has started after this one
            self._epoch, self._sequence = packet.epoch + 1, 0
        return (packet.epoch, packet.sequence) == (self._epoch, self._sequence)

    def _report(self, packet: Packet) -> InEffect:
        half = len(packet.values) // 2
        self._size, self._tick = half, max(self._tick, packet.tick)
        return InEffect(max(packet.tick - 1, 0), packet.values[:half], packet.values[half:], manual=self._manual)

    def _encoded(self, kind: PacketKind, values: tuple[float, ...]) -> bytes:
        packet = Packet(kind, SETPOINT, self._tick, self._sequence, values, self._epoch)
        return self._frames(self._size).encode(packet)

    def _frames(self, size: int) -> Frames:
        """Return the encoder and decoder of the packets of the known policy."""
        assert self._policy is not None, "the controller has answered"
        fingerprint, link = self._policy
        return Frames(fingerprint, {link: SETPOINT}, operator_shapes(SETPOINT, size, self._inputs), self._keys)

    def _until_answered(self, datagram: Callable[[], bytes]) -> Iterator[Packet]:
        """Send a datagram again and again, and yield what arrives meanwhile; answer challenges."""
        end = self._clock() + self._patience
        while self._clock() < end:
            self._port.send(datagram(), self._to)
            again = min(end, self._clock() + AGAIN)
            while self._clock() < again:
                for one in self._port.receive(again):
                    packet = self._decoded(one)
                    if packet is not None and packet.kind == "challenge":
                        answer = answer_to(packet, self._epoch, self._tick)
                        self._port.send(self._frames(self._size).encode(answer), self._to)
                        self._port.send(datagram(), self._to)
                    elif packet is not None:
                        yield packet

    def _decoded(self, datagram: bytes) -> Packet | None:
        """Return a valid packet of the controller. The answer to the challenge makes its policy known."""
        if len(datagram) < HEADER_SIZE:
            return None
        kind, link = datagram[OFFSETS["kind"]], datagram[OFFSETS["link"]]
        policy = int.from_bytes(datagram[OFFSETS["fingerprint"] : OFFSETS["fingerprint"] + 8], "big")
        answers = kind == KINDS.index("answer")
        if not answers and self._policy != (policy, link):
            return None
        size = datagram[OFFSETS["entries"]] // 2 if kind == KINDS.index("report") else self._size
        inputs = datagram[OFFSETS["entries"]] - 1 if kind == KINDS.index("mode") else self._inputs
        shapes = operator_shapes(SETPOINT, size, max(0, inputs))
        packet = Frames(policy, {link: SETPOINT}, shapes, self._keys).decode(datagram)
        if isinstance(packet, str) or (answers and (not packet.back or packet.nonce != self._nonce)):
            return None
        if answers:
            self._policy = policy, link
        if packet.kind == "mode":
            by_hand, *values = packet.values
            self._inputs, self._manual = len(values), tuple(values) if by_hand > 0.0 else None
        return packet


def _text(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.12g}" for value in values)
