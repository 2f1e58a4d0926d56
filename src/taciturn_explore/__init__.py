"""Interactive page of ``taciturn explore``: it shows the cost and the traffic of a problem while users change settings.

1. ``setting``: one immutable value, a problem with its changes, the seed and the events, and its text, the address of
   the page. ``files``: the problem file, the lines of Python and the command that give the same digits.
2. ``controls``: the controls of a setting, made from the records of the policy kinds.
3. Parts of answers, each a pure function of a setting: ``plane`` (cost against priced traffic, with its curves, at the
   values of ``curves``), ``response`` (a path of the policy and of periodic control on the same noise, with events;
   ``disturbed`` runs it) and ``network`` (the links, and the intervals between their packets). ``answers``: all of them
   by name, with caches.
4. ``work``: the processes that compute answers. ``session``: the answers to a setting in their order.
5. ``server``: the page on this machine. ``commands``: the command ``explore``.
6. ``recording``: the record of a run, from logs (``recorded_nodes``), documents and tables (``recorded_runs``), folders
   (``recorded_folder``), and files of twins (``recorded_twins``).
7. Without a server: ``bundle`` joins the scripts, ``saved`` writes a page with precomputed answers, and ``notebook`` is
   the page in a cell of a notebook.

The page (``web/``) consists of ES modules without a build step. It draws, and moves numbers from controls to settings;
every number that it shows comes from an answer.
"""
