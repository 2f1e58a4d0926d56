"""Measured delays of packets, read from files of common tools, and written as traces for problem files.

``delays`` has the function ``read_delays`` and its result, and ``commands`` the command ``taciturn delays``. ``forms``
recognises the form of a file, and calls its reader: ``ping`` for the output of ping, ``messages`` for logs of MQTT,
``captures`` for exports of captured packets, and ``traces`` for files of this library. All readers return a ``Reading``
(``reading``), and use ``tables`` for delimited text and ``instants`` for times. ``envelope`` compares the times of two
computers, and ``statistics`` computes the statistics of delays and losses. ``critical`` computes which delay would make
a loop unstable.
"""
