"""Nodes, plants and links as processes that exchange UDP packets.

``endpoint`` is the only module that opens UDP sockets. ``service`` is what all servers share, ``nodes`` serves nodes,
``plant`` plants, and ``relay`` links that drop packets. ``processes`` starts them on this machine and ``namespaces``
puts links between them into the kernel. ``run`` runs a network and measures its cost: ``taciturn.run_network``.
``commands`` has the commands ``network``, ``node``, ``plant`` and ``relay``. The nodes themselves are in
``taciturn.nodes``, without sockets.
"""
