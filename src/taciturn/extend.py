"""Names for packages that extend Taciturn: checked arrays, texts, figures, files, progress, and the end of a command.

Such a package uses these names, the public names of ``taciturn``, and its modules without an underscore. Its entry
points add commands, functions, built-in problems and policy kinds.
"""

from taciturn._arrays import NO_VARIANCE as NO_VARIANCE
from taciturn._arrays import Array as Array
from taciturn._arrays import ArrayLike as ArrayLike
from taciturn._arrays import Bits as Bits
from taciturn._arrays import array as array
from taciturn._arrays import choice as choice
from taciturn._arrays import count as count
from taciturn._arrays import expect_unmasked as expect_unmasked
from taciturn._arrays import frozen as frozen
from taciturn._arrays import instance as instance
from taciturn._arrays import is_definite as is_definite
from taciturn._arrays import number as number
from taciturn._arrays import quoted as quoted
from taciturn._arrays import semidefinite as semidefinite
from taciturn._arrays import square as square
from taciturn._arrays import symmetrised as symmetrised
from taciturn._display import Displayed as Displayed
from taciturn._figure import Panel as Panel
from taciturn._figure import Series as Series
from taciturn._figure import Size as Size
from taciturn._figure import Style as Style
from taciturn._figure import check_format as check_format
from taciturn._figure import draw as draw
from taciturn._figure import save as save
from taciturn._files import delete_parts as delete_parts
from taciturn._files import read_bytes as read_bytes
from taciturn._files import read_text as read_text
from taciturn._files import temporary_folder as temporary_folder
from taciturn._files import why_unreadable as why_unreadable
from taciturn._files import write_whole as write_whole
from taciturn._modes import balancing as balancing
from taciturn._modes import closure as closure
from taciturn._modes import factor as factor
from taciturn._modes import pace as pace
from taciturn._modes import radius as radius
from taciturn._modes import root as root
from taciturn._plugins import find_plugins as find_plugins
from taciturn._plugins import load_plugin as load_plugin
from taciturn._process import ENDED as ENDED
from taciturn._process import GRACE as GRACE
from taciturn._process import LIFELINE as LIFELINE
from taciturn._process import at_once as at_once
from taciturn._process import remark as remark
from taciturn._process import until_stopped as until_stopped
from taciturn._progress import OutOfTime as OutOfTime
from taciturn._progress import Progress as Progress
from taciturn._progress import Stages as Stages
from taciturn._progress import answered_within as answered_within
from taciturn._progress import check_time as check_time
from taciturn._progress import in_notebook as in_notebook
from taciturn._progress import seconds_left as seconds_left
from taciturn._rational import precision as precision
from taciturn._scipy import crossing as crossing
from taciturn._scipy import least_squares as least_squares
from taciturn._scipy import normal_quantile as normal_quantile
from taciturn._scipy import sobol as sobol
from taciturn._text import WIDTH as WIDTH
from taciturn._text import pairs_text as pairs_text
from taciturn._text import per_unit as per_unit
from taciturn._text import percent as percent
from taciturn._text import table_text as table_text
from taciturn._text import wrapped_text as wrapped_text
