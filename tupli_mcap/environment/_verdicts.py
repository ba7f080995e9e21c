"""What the things that a pickle imports are known for.

Nothing is decided by this: a pickle runs only if it is trusted, whatever it imports. It tells a reader where to look
first. Lists of dangerous names are never complete, so that what is on neither list is "unknown", not "harmless".
"""

from __future__ import annotations

from typing import Literal

__all__ = ["Verdict", "is_telling", "verdict_of"]

Verdict = Literal["known", "unknown", "dangerous"]


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


# The first part of a module, or any part of a name (`gymnasium.envs.registration:importlib.import_module`).
_DANGEROUS_MODULES = _words(
    """
    __builtin__ _asyncio _ctypes _io _operator _osx_support _pickle _posixsubprocess _socket _sqlite3 _thread
    _xxsubinterpreters aiohttp ast asyncio atexit bdb builtins cffi cgitb cloudpickle cmd code codeop commands
    concurrent ctypes dbm dill distutils doctest ensurepip faulthandler fileinput fsspec ftplib functools gc glob http
    httplib idlelib imaplib imp importlib inspect io joblib linecache marshal mmap modulefinder multiprocessing nt
    ntpath numba operator os paramiko pathlib pdb pexpect pickle pip pipes pkg_resources pkgutil platform poplib popen2
    posix posixpath profile pstats pty py_compile pydoc requests resource runpy sched select selectors setuptools
    shelve shlex shutil signal site smtplib socket socketserver sqlite3 ssl subprocess sys sysconfig telnetlib tempfile
    threading timeit trace tracemalloc types urllib urllib2 urllib3 uuid venv webbrowser winreg xmlrpc zipapp zipfile
    zipimport
    """
)
_DANGEROUS_NAMES = _words(
    """
    Popen __builtins__ __class__ __code__ __dict__ __getattribute__ __globals__ __import__ __loader__ __mro__ __reduce__
    __reduce_ex__ __spec__ __subclasses__ apply attrgetter breakpoint check_call check_output compile delattr eval exec
    exec_module execfile execl execv execve fork get_ipython getattr getoutput globals import_module load load_library
    load_module loads memmap open popen resolve_name rmtree run_code run_line_magic run_module run_path runstring
    setattr spawn spawnl spawnv startfile system unlink urlopen vars write_bytes write_text
    """
)
# In the names that a function mentions, `self.load` and `x.compile` are everyday.
_TELLING_NAMES = _words(
    """
    Popen __builtins__ __globals__ __import__ __subclasses__ check_call check_output ctypes eval exec execv execve fork
    getoutput importlib import_module marshal open os pickle popen pty requests rmtree runpy shutil socket subprocess
    sys system unlink urllib urlopen
    """
)
_KNOWN: dict[str, frozenset[str]] = {
    "_codecs": frozenset({"encode"}),
    "builtins": frozenset(
        {
            *("bool", "bytearray", "bytes", "complex", "dict", "float", "frozenset", "int", "list", "object"),
            *("property", "range", "set", "slice", "staticmethod", "classmethod", "str", "tuple", "type"),
        }
    ),
    "collections": frozenset({"OrderedDict", "defaultdict", "deque", "Counter"}),
    "copyreg": frozenset({"_reconstructor", "__newobj__"}),
    "cloudpickle.cloudpickle": frozenset(
        {
            *("_builtin_type", "_class_setstate", "_function_setstate", "_make_cell", "_make_empty_cell"),
            *("_make_function", "_make_skeleton_class", "_make_skeleton_enum", "_make_dict_keys"),
            *("_make_dict_values", "_make_dict_items", "_make_typevar", "subimport"),
        }
    ),
    "gymnasium.envs.registration": frozenset({"EnvSpec", "WrapperSpec"}),
    "gymnasium.utils.ezpickle": frozenset({"EzPickle"}),
    "_operator": frozenset({"getitem"}),  # generic classes: Env[Any, Any]
    "datetime": frozenset({"date", "datetime", "time", "timedelta", "timezone"}),
    "io": frozenset({"BytesIO", "StringIO"}),
    "numpy": frozenset({"dtype", "ndarray"}),
    "pathlib": frozenset({"Path", "PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath"}),
    "tupli_mcap.environment": frozenset({"rebuild_ezpickled"}),
    "types": frozenset({"MappingProxyType", "SimpleNamespace"}),
    "typing": frozenset({"Any", "Generic", "TypeVar"}),
    "uuid": frozenset({"UUID"}),
}
_KNOWN_MODULES = frozenset(
    {"collections", "gymnasium", "gymnasium.spaces", "itertools", "math", "numpy", "random"}
)
_NUMPY_REBUILDS = frozenset(
    {
        *("_reconstruct", "scalar", "_frombuffer", "__generator_ctor", "__bit_generator_ctor"),
        *(
            "__randomstate_ctor",
            "SeedSequence",
            "PCG64",
            "Generator",
            "MT19937",
            "__pyx_unpickle_SeedSequence",
        ),
    }
)
_CLASSES_IN = ("gymnasium.core", "gymnasium.spaces", "gymnasium.wrappers", "gymnasium.envs")


def verdict_of(module: str, name: str) -> Verdict:
    """Of one import; `name` is empty for a module. All parts of a dotted name count: it may lead to other modules."""
    if _is_known(module, name):
        return "known"
    parts = name.split(".")
    reached = [module.partition(".")[0], *parts]
    if any(part in _DANGEROUS_MODULES for part in reached) or any(part in _DANGEROUS_NAMES for part in parts):
        return "dangerous"
    return "unknown"


def is_telling(name: str) -> bool:
    """Whether a name that a function mentions deserves a look."""
    return name in _TELLING_NAMES


def _is_known(module: str, name: str) -> bool:
    if not name:
        return module in _KNOWN_MODULES
    if name in _KNOWN.get(module, frozenset()):
        return True
    if "." in name:
        return False
    if module.partition(".")[0] == "numpy":
        return name in _NUMPY_REBUILDS
    # Classes by their spelling: `gymnasium.envs.registration` also has `make` and `importlib`.
    is_class = name[:1].isupper() and name != "RecordVideo"
    return is_class and any(module == top or module.startswith(f"{top}.") for top in _CLASSES_IN)
