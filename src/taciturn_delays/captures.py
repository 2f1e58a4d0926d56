"""Reader of captured packets that tshark has exported as text, from one computer or from two.

At each computer, or of each capture file,

    tshark -r FILE -T fields -E header=y -E separator=, -E occurrence=f -e frame.time_epoch -e ip.id -e udp.length

writes a table with the time of each packet and fields that identify it. With two files, packets of the sender are
matched with those of the receiver by all known fields that both have (``FIELDS``), or by a stated one. Fields of 16
bits repeat, so the packet of the sender is that whose time is closest to the time of reception minus the offset of both
computers, for which the median over first occurrences is accurate enough. If the fields repeat so soon that another
packet could be meant, the files are refused. A packet that the receiver has twice is a duplicate, and one that it does
not have is lost.

With one file, a packet and the next one with the same fields from another address are a request and its answer, whose
distance is a round trip. The address is in ip.src, ipv6.src, eth.src or udp.srcport.
"""

from __future__ import annotations

from bisect import bisect_left
from pathlib import Path

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, number_of
from taciturn_delays.instants import instant, seconds
from taciturn_delays.reading import Names, Reading, Whole, ordered
from taciturn_delays.tables import Table, expect_column, read_table

TIME = "frame.time_epoch"
FIELDS = (
    "ip.id", "rtp.seq", "rtp.ssrc", "icmp.seq", "icmp.ident", "icmpv6.echo.sequence_number", "udp.payload", "data.data",
    "udp.length", "tcp.seq_raw", "dns.id", "coap.mid", "mqtt.msgid", "mbtcp.trans_id", "opcua.transport.rqid",
)  # fmt: skip
ADDRESSES = ("ip.src", "ipv6.src", "eth.src", "udp.srcport", "tcp.srcport")
_UNLIKE = ("ip.id", "udp.length")  # in which an answer differs from its request
_DISTINCT = 16  # different identities, so that the offset of both computers is that of most packets
_APART = 4.0  # times of sending of packets with the same identity, relative to the variation of the delays


def read_two_captures(sender: tuple[Path, str], receiver: tuple[Path, str], names: Names) -> Reading:
    """Read captures of the sender and of the receiver."""
    tables = [read_table(*one) for one in (sender, receiver)]
    known = [name for name in tables[0].names if name in FIELDS and name in tables[1].names]
    fields = known if names.number is None else [expect_column(one, names.number, (), "id") for one in tables][:1]
    if not fields:
        raise ProblemError(
            f"the files {str(sender[0])!r} and {str(receiver[0])!r} have no common field that identifies a packet; "
            "expected one, such as ip.id: export it with -e ip.id, or name another field with --id"
        )
    (sent, keys), (received, seen) = (_packets(one, names, fields) for one in tables)
    start = int(sent.min())
    matched, duplicates, unknown = _match(tables, fields, (sent, keys), (received, seen))
    elapsed = np.full(len(sent), np.inf)
    for at, time in matched.items():
        elapsed[at] = (time - int(sent[at])) / 1e9
    notes = [f"matched by {' and '.join(fields)}"]
    if unknown:
        notes.append(f"{number_of(unknown, 'packet')} at the receiver without a packet of the sender left out")
    return ordered("captures of tshark", seconds(sent, start), elapsed, "two computers", duplicates, tuple(notes))


def read_one_capture(path: Path, text: str, names: Names) -> Reading:
    """Read a capture of requests and answers."""
    table = read_table(path, text)
    known = [name for name in table.names if name in FIELDS and name not in _UNLIKE]
    fields = known if names.number is None else [expect_column(table, names.number, (), "id")]
    if not fields:
        raise ProblemError(
            f"the file {str(path)!r} has no field that a request and its answer have in common; expected one, such as "
            "icmp.seq or coap.mid: export it, name it with --id, or add the file of the receiver as a second file"
        )
    source = expect_column(table, None, ADDRESSES, "source of the packets (-e ip.src)")
    times, keys = _packets(table, names, fields)
    origin = table.column(source)
    order = _in_order(times)
    sent, elapsed = list[int](), list[float]()
    waiting: dict[tuple[str, ...], tuple[int, str]] = {}  # place and source of a request without an answer
    duplicates = 0
    answered: dict[tuple[str, ...], str] = {}
    first = origin[order[0]]
    for i in order:
        key, time = keys[i], int(times[i])
        request = waiting.get(key)
        if request is not None and request[1] != origin[i]:
            elapsed[request[0]] = (time - sent[request[0]]) / 1e9
            answered[key] = origin[i]
            del waiting[key]
        elif request is None and answered.get(key) == origin[i]:
            duplicates += 1
        elif origin[i] == first:
            waiting[key] = (len(sent), origin[i])
            answered.pop(key, None)
            sent.append(time)
            elapsed.append(np.inf)
    if not np.isfinite(elapsed).any():
        raise ProblemError(
            f"the file {str(path)!r} has no answer: no packet with the same {' and '.join(fields)} from another "
            f"{source}; expected requests and answers, or the file of the receiver as a second file"
        )
    note = f"requests of {first}, matched with answers by {' and '.join(fields)}"
    return ordered("capture of tshark", seconds(sent, sent[0]), np.array(elapsed), "round trip", duplicates, (note,))


def _in_order(times: Whole) -> list[int]:
    """Return the places of sorted times."""
    return [int(i) for i in np.argsort(times, kind="stable")]


def _packets(table: Table, names: Names, fields: list[str]) -> tuple[Whole, list[tuple[str, ...]]]:
    """Return times in nanoseconds and identities of the packets in a table."""
    time = expect_column(table, None, (TIME,), "time")
    times = [instant(f"{time} in {table.where(i)}", cell) for i, cell in enumerate(table.column(time))]
    keys = list(zip(*(table.column(name) for name in fields), strict=True))
    empty = next((i for i, key in enumerate(keys) if not any(key)), None)
    if empty is not None:
        raise ProblemError(
            f"{table.where(empty)} has no {' and no '.join(fields)}; expected packets of one stream: filter them, as "
            "by tshark -Y 'udp.port == 5000'"
        )
    return np.array(times, dtype=np.int64), keys


def _match(
    tables: list[Table], fields: list[str], sender: tuple[Whole, list[tuple[str, ...]]],
    receiver: tuple[Whole, list[tuple[str, ...]]],
) -> tuple[dict[int, int], int, int]:  # fmt: skip
    """Return the time of reception of each received packet, by its place at the sender, and counts of the others."""
    (sent, keys), (received, seen) = sender, receiver
    places: dict[tuple[str, ...], list[int]] = {}
    for i in _in_order(sent):
        places.setdefault(keys[i], []).append(i)
    firsts: dict[tuple[str, ...], int] = {}
    for j in _in_order(received):
        firsts.setdefault(seen[j], j)
    common = [(places[key][0], j) for key, j in firsts.items() if key in places]
    where = f"{str(tables[0].path)!r} and {str(tables[1].path)!r}"
    if not common:
        raise ProblemError(
            f"no packet of {where} has the same {' and '.join(fields)}; expected files of the same packets: check that "
            "the fields do not change on the way, or name another field with --id"
        )
    if len(places) < min(_DISTINCT, len(sent)):
        raise ProblemError(
            f"the {' and '.join(fields)} of {number_of(len(sent), 'packet')} in {where} have only "
            f"{number_of(len(places), 'value')}; expected fields that identify a packet: export another one, such as "
            "-e udp.payload"
        )
    offset = int(np.median(np.array([received[j] - sent[i] for i, j in common])))
    found: dict[int, int] = {}
    duplicates = unknown = 0
    rest: Array = np.zeros(len(seen))
    for j, key in enumerate(seen):
        here = places.get(key)
        if here is None:
            unknown += 1
            continue
        near = bisect_left(here, int(received[j]) - offset, key=lambda i: int(sent[i]))
        best = min(here[max(near - 1, 0) : near + 1], key=lambda i: abs(int(received[j]) - offset - int(sent[i])))
        rest[j] = abs(int(received[j]) - offset - int(sent[best]))
        duplicates += best in found
        found[best] = min(found.get(best, int(received[j])), int(received[j]))
    gaps = [int(np.diff(sent[here]).min()) for here in places.values() if len(here) > 1]
    if gaps and min(gaps) < _APART * float(rest.max()):
        raise ProblemError(
            f"the {' and '.join(fields)} in {where} repeat after {min(gaps) / 1e9:g} s, while delays vary by "
            f"{float(rest.max()) / 1e9:g} s; expected fields that identify a packet: export another one, such as "
            "-e udp.payload, or filter the packets of one stream and direction"
        )
    return found, duplicates, unknown
