"""The design functions and their types, for type checkers and editors; the catalogue finds and imports each."""

from taciturn.design.kinds.absolute import absolute as absolute
from taciturn.design.kinds.all_time import all_time as all_time
from taciturn.design.kinds.consistent import consistent as consistent
from taciturn.design.kinds.downsampled import downsampled as downsampled
from taciturn.design.kinds.dynamic import dynamic as dynamic
from taciturn.design.kinds.event_pid import event_pid as event_pid
from taciturn.design.kinds.event_pid_saturated import event_pid_saturated as event_pid_saturated
from taciturn.design.kinds.excess import excess as excess
from taciturn.design.kinds.lossy_lqg import lossy_lqg as lossy_lqg
from taciturn.design.kinds.lqg import lqg as lqg
from taciturn.design.kinds.mixed import mixed as mixed
from taciturn.design.kinds.periodic import periodic as periodic
from taciturn.design.kinds.periodic_schedule import periodic_schedule as periodic_schedule
from taciturn.design.kinds.relative import relative as relative
from taciturn.design.kinds.remote_lqg import remote_lqg as remote_lqg
from taciturn.design.kinds.rollout import rollout as rollout
from taciturn.design.kinds.self_triggered import self_triggered as self_triggered
from taciturn.design.kinds.send_on_delta import send_on_delta as send_on_delta
from taciturn.design.kinds.stochastic import stochastic as stochastic
from taciturn.design.kinds.symmetric_send_on_delta import symmetric_send_on_delta as symmetric_send_on_delta
from taciturn.design.kinds.variance import variance as variance
from taciturn_events.integral import integral as integral
from taciturn_limits.near_optimal_kind import near_optimal as near_optimal
from taciturn_limits.optimal_kind import optimal as optimal
