"""Names for packages that extend Taciturn: checked arrays, texts, figures, files, progress, and the end of a command.

Such a package uses these names, the public names of ``taciturn``, and its modules without an underscore. Its entry
points add commands, functions, built-in problems and policy kinds.
"""

from taciturn._arrays import Array as Array
from taciturn._arrays import ArrayLike as ArrayLike
from taciturn._arrays import array as array
from taciturn._arrays import choice as choice
from taciturn._arrays import count as count
from taciturn._arrays import frozen as frozen
from taciturn._arrays import number as number
from taciturn._arrays import symmetrised as symmetrised
from taciturn._display import Displayed as Displayed
from taciturn._ending import until_stopped as until_stopped
from taciturn._figure import Panel as Panel
from taciturn._figure import Series as Series
from taciturn._figure import Size as Size
from taciturn._figure import Style as Style
from taciturn._figure import check_format as check_format
from taciturn._figure import draw as draw
from taciturn._figure import save as save
from taciturn._files import read_text as read_text
from taciturn._files import temporary_folder as temporary_folder
from taciturn._files import write_whole as write_whole
from taciturn._plugins import find_plugins as find_plugins
from taciturn._plugins import load_plugin as load_plugin
from taciturn._progress import Progress as Progress
from taciturn._progress import in_notebook as in_notebook
from taciturn._scipy import least_squares as least_squares
from taciturn._text import pairs_text as pairs_text
from taciturn._text import percent as percent
from taciturn._text import table_text as table_text
from taciturn._text import wrapped_text as wrapped_text
