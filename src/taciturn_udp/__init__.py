"""Nodes, plants and emulated links, each run as a process, that exchange packets over UDP.

``endpoint`` is the only module that opens UDP sockets. ``service`` is what all servers share, with ``proofs`` that a
sender runs and ``logs``. ``nodes`` serves nodes, ``plant`` plants, and ``relay`` links that drop packets. ``processes``
starts them on this machine and ``namespaces`` puts links between them into the kernel. ``run`` runs a network:
``taciturn.run_network``. Its ``result`` contains ``averages`` of the recorded steps, and ``record`` writes its packets
and signals to a folder.
``commands`` has the commands ``network``, ``node``, ``plant`` and ``relay``. The nodes themselves are in
``taciturn.nodes``, without sockets.
"""
