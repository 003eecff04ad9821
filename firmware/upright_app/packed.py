# Replaces lib/upright/__init__ on a board whose file system is too small: it unpacks each module when it is imported.
# The modules are beside it as NAME.z, compressed .mpy files; the package's own __init__ is init.z. `upright flash`
# installs it when necessary. Needs deflate; runs on every port that has it.

import os

import deflate

_FOLDER = __file__[: __file__.rfind("/")]  # .../upright
_PLACE = "/upright_z"


class _Packed:
    """A file system of the modules: /upright/NAME.mpy and /upright_app/NAME.mpy, read only."""

    def mount(self, readonly, mkfs):
        pass

    def umount(self):
        pass

    def stat(self, path):
        return os.stat(_packed(path))

    def open(self, path, mode):
        return deflate.DeflateIO(open(_packed(path), "rb"), deflate.ZLIB)


def _packed(path):
    path = path.strip("/")
    if path.endswith(".mpy"):
        path = path[:-3] + "z"
    elif path.endswith(".py"):
        raise OSError(2)
    return "%s/%s" % (_FOLDER[: _FOLDER.rfind("/")], path)


try:
    os.mount(_Packed(), _PLACE)
except OSError:
    pass  # it is there already
__path__ = _PLACE + "/upright"
from upright.init import *  # noqa: E402, F403
from upright.init import __version__  # noqa: E402, F401
