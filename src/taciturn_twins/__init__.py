"""Digital twins of two robots: simulations that repeat the experiments of chapters 6 and 7 of the thesis.

**The experiment.** A robot moves, a camera measures its pose, and a controller decides when to send an input. The rover
(`rover`) drives along a line, with the policy ``remote-lqg``. The omni-directional robot (`omni`) follows two circles
over links that drop packets, with the policy ``lossy-lqg``. `robot` defines the data of a robot, `catalogue` lists the
robots by name, and `mission` creates the problem file with model, cost, network and policy.

**Model.** The controller uses no parameter of the simulator. `prepared.prepare` performs two experiments, as in a
laboratory:

* `calibration` determines the lens parameters and the pose of the camera from pictures of a board and of landmarks.
* `identification` drives the robot in open loop, measures its pose with that camera, and fits x⁺ = x + Bu + w.

**One trial** (`trial.run_trial`) starts one process per node and per link on this machine. The processes exchange UDP
packets::

    world ──time──→ sensor ──request──→ camera ──picture──→ controller ──input──→ actuator ──→ world
      └──────────────── pose ─────────────↑      (lossy)      (eye)      (lossy)

* `world` moves the rigid bodies (`body`, in MuJoCo). It sends time steps to the sensor and poses to the camera.
* The sensor sends a packet without numbers when its policy would send a measurement: a request for a picture.
* `serve` is the camera's process. It renders a requested picture (`camera`, `scenery`) and sends it as JPEG.
* `control` converts the picture to a measurement (`vision`, `polygons`) for the controller node of the policy.
* `faults` defines faults of bodies, camera, links or processes at given times. `wire` defines the packets.

Time is virtual by default: a step ends when its packets have arrived, so a seed determines the run bit for bit. In
real time, the world does not wait, and a late packet has a late effect.

**Results.** Each process logs its steps and reports its counters. `outcome` combines them into a `Trial` and accounts
for every datagram. `run.run_twin` adds the same trial with the policy that sends every sample. `report`, `dataset`,
`record` and `figures` write the results, and `reproduction` arranges them as in the thesis.

**Live page.** `live.watch_twin` runs one round after another. `steps` combines the logs of a running trial into one
row per step. `baseline` runs the loop that sends every sample synchronously, with the same seed, disturbances, faults,
losses and pushes. `page` passes the rows to a log that any number of browsers read at different speeds, and the
requests of users (pause, push, parameter) to the round. `taciturn_web` serves it, and the files in ``web/``.

`commands` has the commands `twin` and `camera`. `_cv2` and `_mujoco` are the typed interfaces to optional
dependencies.

To add a robot, write a module like `rover` with a `Robot`, and add an entry to `catalogue` and to `mission`.
"""
