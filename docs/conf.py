"""How the site is made of the pages here; `tools/docs` calls it. See docs/_ext for what is generated."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import uuid
from importlib.metadata import version as version_of
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE / "_ext"), str(ROOT / "tests" / "support")]

import jupyter_client  # noqa: E402
import recordings  # noqa: E402
from traitlets import default  # noqa: E402

project = "tupli-mcap"
author = "the tupli-mcap developers"
project_copyright = "the tupli-mcap developers, MIT licence"
release = version = version_of("tupli-mcap")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    "generated",
    "api",
    "console",
]
exclude_patterns = ["_*", "changes", "**.ipynb_checkpoints"]
suppress_warnings = ["mystnb.unknown_mime_type"]  # a cell may show more than a page of HTML can
nitpicky = True
nitpick_ignore_regex = [  # what other projects document is not linked: a build needs no network
    (r"py:.*", r"(?!tupli_mcap\b).*"),
]

# --- text ---

myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist", "fieldlist"]
myst_heading_anchors = 4
myst_links_external_new_tab = False
smartquotes = False

# --- pages that run ---

nb_execution_mode = os.environ.get("TUPLI_MCAP_DOCS_EXECUTE", "force")
nb_execution_in_temp = True
nb_execution_raise_on_error = False  # a warning, of which `tools/docs` makes an error
nb_execution_show_tb = True
nb_execution_timeout = 180
nb_merge_streams = True
nb_ipywidgets_js = {}  # no scripts from other hosts

_home = Path(tempfile.mkdtemp(prefix="tupli-mcap-docs-"))
_startup = _home / "ipython" / "profile_default" / "startup"
_startup.mkdir(parents=True)
(_startup / "00-cells.py").write_text((HERE / "_ext" / "cells.py").read_text(encoding="utf-8"))
(_startup.parent / "ipython_kernel_config.py").write_text("c.IPKernelApp.log_level = 40\n")
# d3rlpy pins another Gymnasium: its tutorial runs in an environment of its own.
_kernel = _home / "jupyter" / "kernels" / "d3rlpy" / "kernel.json"
_kernel.parent.mkdir(parents=True)
_python = str(ROOT / ".venv-d3rlpy" / "bin" / "python")
_start = [_python, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
_kernel.write_text(json.dumps({"argv": _start, "display_name": "d3rlpy", "language": "python"}))
os.environ |= {
    "JUPYTER_PATH": str(_home / "jupyter"),
    "IPYTHONDIR": str(_home / "ipython"),
    "TUPLI_MCAP_CONFIG_DIR": str(_home / "config"),
    "TUPLI_MCAP_CACHE_DIR": str(_home / "cache"),
    "TUPLI_MCAP_DATA_DIR": str(_home / "data"),
    "PYTHONPATH": os.pathsep.join(
        filter(None, (str(ROOT / "tests" / "support"), os.environ.get("PYTHONPATH")))
    ),
    "TUPLI_MCAP_DOCS_RECORDINGS": str(_home / "recordings"),
    "TUPLI_MCAP_DOCS_EXAMPLES": str(ROOT / "examples"),
    "COLUMNS": "96",
    "TZ": "UTC",
    "XDG_RUNTIME_DIR": str(_home),  # SDL complains without
    "PYDEVD_DISABLE_FILE_VALIDATION": "1",
}


class _KernelManager(jupyter_client.AsyncKernelManager):
    """Speaks to its kernel by files: of several kernels that start at once, two may choose the same TCP port."""

    @default("transport")
    def _by_files(self) -> str:
        return "ipc"

    @default("ip")
    def _file(self) -> str:
        return str(_home / uuid.uuid4().hex)


jupyter_client.AsyncKernelManager = _KernelManager  # what nbclient, and so myst-nb, takes
recordings.make(_home / "recordings")

# --- the API ---

autodoc_mock_imports = ["d3rlpy"]
autodoc_member_order = "bysource"
autodoc_default_options = {
    "members": True,
    "inherited-members": "ABC,BaseException,BaseModel,Dataset,Env,Enum,Exception,Generic,IntEnum,"
    "IterableDataset,Mapping,Sequence,StrEnum,int,VecEnvWrapper,VectorWrapper,Wrapper,dict,list,object,str,tuple",
}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
python_display_short_literal_types = True
maximum_signature_line_length = 80
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_custom_sections = [("Fields", "params_style")]
toc_object_entries_show_parents = "hide"

# --- how it looks ---

html_theme = "furo"
html_title = f"tupli-mcap {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos, .gp, .go"
pygments_style = "friendly"
pygments_dark_style = "monokai"
