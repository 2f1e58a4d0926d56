"""The public names and their types, for type checkers and editors; ``__init__.py`` imports each when it is used."""

from taciturn import design as design
from taciturn.errors import ProblemError as ProblemError
from taciturn.errors import TaciturnError as TaciturnError
from taciturn.errors import UnstableError as UnstableError
from taciturn.loop import Loop as Loop
from taciturn.loop import close as close
from taciturn.model.controller import PID as PID
from taciturn.model.controller import Controller as Controller
from taciturn.model.controller import controller_from as controller_from
from taciturn.model.cost import Cost as Cost
from taciturn.model.disturbance import Disturbance as Disturbance
from taciturn.model.disturbance import Reference as Reference
from taciturn.model.dynamics import integrate as integrate
from taciturn.model.dynamics import linearise as linearise
from taciturn.model.estimate import Estimate as Estimate
from taciturn.model.losses import Burst as Burst
from taciturn.model.network import Network as Network
from taciturn.model.plant import ContinuousPlant as ContinuousPlant
from taciturn.model.plant import Jumps as Jumps
from taciturn.model.plant import Plant as Plant
from taciturn.model.policy import Policy as Policy
from taciturn.model.state_space import plant_from as plant_from
from taciturn.model.theory import Guarantee as Guarantee
from taciturn.model.theory import Theory as Theory
from taciturn.model.trigger import Trigger as Trigger
from taciturn.nodes.together import Nodes as Nodes
from taciturn.problem import Problem as Problem
from taciturn.problem import load as load
from taciturn.simulation.average import average as average
from taciturn.simulation.average import difference as difference
from taciturn.simulation.trajectory import simulate as simulate
from taciturn.study.evaluate import evaluate as evaluate
from taciturn_certify.certify import certify as certify
from taciturn_channel.share import share_channel as share_channel
from taciturn_control.systems import from_control as from_control
from taciturn_control.systems import to_control as to_control
from taciturn_export.export import export_c as export_c
from taciturn_export.export import export_fmu as export_fmu
from taciturn_studies.compare import compare as compare
from taciturn_studies.tradeoff import tradeoff as tradeoff
from taciturn_studies.tune import tune as tune
from taciturn_sweep.sweep import sweep as sweep
from taciturn_thesis.reproduce import reproduce as reproduce
from taciturn_udp.run import run_network as run_network

__version__: str
