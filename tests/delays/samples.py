"""Outputs of ping as systems print them, and logs and captures of packets with known delays."""

from __future__ import annotations

from collections.abc import Sequence

LINUX = """\
PING 192.168.1.20 (192.168.1.20) 56(84) bytes of data.
[1700000000.204210] 64 bytes from 192.168.1.20: icmp_seq=1 ttl=64 time=4.21 ms
[1700000001.205020] 64 bytes from 192.168.1.20: icmp_seq=2 ttl=64 time=5.02 ms
[1700000003.207111] no answer yet for icmp_seq=3
[1700000003.203980] 64 bytes from 192.168.1.20: icmp_seq=4 ttl=64 time=3.98 ms
[1700000004.204050] 64 bytes from 192.168.1.20: icmp_seq=5 ttl=64 time=4.05 ms
[1700000004.204950] 64 bytes from 192.168.1.20: icmp_seq=5 ttl=64 time=4.95 ms (DUP!)
From 192.168.1.10 icmp_seq=6 Destination Host Unreachable

--- 192.168.1.20 ping statistics ---
7 packets transmitted, 4 received, +1 duplicates, +1 errors, 42.8571% packet loss, time 6011ms
rtt min/avg/max/mdev = 3.980/4.315/5.020/0.412 ms
"""
GERMAN_LINUX = """\
PING 10.0.0.7 (10.0.0.7) 56(84) Bytes an Daten.
64 Bytes von 10.0.0.7: icmp_seq=1 ttl=64 Zeit=1.50 ms
64 Bytes von 10.0.0.7: icmp_seq=3 ttl=64 Zeit=1234 ms
64 Bytes von 10.0.0.7: icmp_seq=4 ttl=64 Zeit=2.50 ms

--- 10.0.0.7 ping statistics ---
4 Pakete übertragen, 3 empfangen, 25% packet loss, time 606ms
"""
MAC = """\
PING 10.0.0.7 (10.0.0.7): 56 data bytes
64 bytes from 10.0.0.7: icmp_seq=0 ttl=64 time=11.915 ms
Request timeout for icmp_seq 1
64 bytes from 10.0.0.7: icmp_seq=1 ttl=64 time=1103.207 ms
64 bytes from 10.0.0.7: icmp_seq=2 ttl=64 time=98.200 ms
Request timeout for icmp_seq 3
64 bytes from 10.0.0.7: icmp_seq=4 ttl=64 time=12.377 ms

--- 10.0.0.7 ping statistics ---
5 packets transmitted, 4 packets received, 20.0% packet loss
round-trip min/avg/max/stddev = 11.915/306.425/1103.207/461.322 ms
"""
APPLE_TIME = """\
PING 10.0.0.7 (10.0.0.7): 56 data bytes
23:59:59.900000 64 bytes from 10.0.0.7: icmp_seq=0 ttl=64 time=20.000 ms
00:00:00.910000 64 bytes from 10.0.0.7: icmp_seq=1 ttl=64 time=30.000 ms
"""
BUSYBOX = """\
PING 1.1.1.1 (1.1.1.1): 56 data bytes
64 bytes from 1.1.1.1: seq=0 ttl=59 time=10.126 ms
64 bytes from 1.1.1.1: seq=2 ttl=59 time=9.874 ms

--- 1.1.1.1 ping statistics ---
3 packets transmitted, 2 packets received, 33% packet loss
round-trip min/avg/max = 9.874/10.000/10.126 ms
"""
WINDOWS = """
Pinging example.com [10.0.0.7] with 32 bytes of data:
Reply from 10.0.0.7: bytes=32 time=12ms TTL=64
Request timed out.
Reply from 10.0.0.7: bytes=32 time<1ms TTL=64
Reply from 10.0.0.1: Destination host unreachable.
Reply from 10.0.0.7: bytes=32 time=3ms TTL=64

Ping statistics for 10.0.0.7:
    Packets: Sent = 5, Received = 4, Lost = 1 (20% loss),
Approximate round trip times in milli-seconds:
    Minimum = 0ms, Maximum = 12ms, Average = 5ms
"""
GERMAN_WINDOWS = """
Ping wird ausgeführt für dns.google [8.8.8.8] mit 32 Bytes Daten:
Antwort von 8.8.8.8: Bytes=32 Zeit=12ms TTL=117
Zeitüberschreitung der Anforderung.
Antwort von 8.8.8.8: Bytes=32 Zeit=14ms TTL=117

Ping-Statistik für 8.8.8.8:
    Pakete: Gesendet = 3, Empfangen = 2, Verloren = 1
    (33% Verlust),
Ca. Zeitangaben in Millisek.:
    Minimum = 12ms, Maximum = 14ms, Mittelwert = 13ms
"""
FRENCH_WINDOWS = """
Envoi d'une requête 'Ping'  10.0.0.7 avec 32 octets de données :
Réponse de 10.0.0.7 : octets=32 temps=2 ms TTL=64
Délai d'attente de la demande dépassé.
Réponse de 10.0.0.7 : octets=32 temps<1 ms TTL=64

Statistiques Ping pour 10.0.0.7:
    Paquets : envoyés = 3, reçus = 2, perdus = 1 (perte 33%),
Durée approximative des boucles en millisecondes :
    Minimum = 0ms, Maximum = 2ms, Moyenne = 1ms
"""

START = 1_700_000_000  # seconds since 1970


def capture(times: Sequence[float], identities: Sequence[str], name: str = "ip.id", start: int = START) -> str:
    """Return the export of packets by tshark, with times in seconds after ``start``, rounded to nanoseconds."""
    stamps = [round(time * 1e9) + start * 10**9 for time in times]
    rows = [f"{time // 10**9}.{time % 10**9:09d},{one}" for time, one in zip(stamps, identities, strict=True)]
    return "\n".join([f"frame.time_epoch,{name}", *rows, ""])
