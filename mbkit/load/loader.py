"""`load`: a robot's name or a file in, a `Model` out; and the robots of example-robot-data by name.

Loops that a file does not hold: given beside it, as arguments of `ModelBuilder.add_loop` or in a TOML file.
"""

from __future__ import annotations

import builtins
import importlib.metadata
import inspect
import os
import re
import tomllib
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from importlib.util import find_spec
from pathlib import Path
from types import NoneType, SimpleNamespace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import shown
from mbkit._imports import from_above
from mbkit._reproducible import product
from mbkit.errors import InputError, LoadError, MbkitError, MbkitWarning, ModelError, UnknownNameError, nearest, warn
from mbkit.load import xml_reader
from mbkit.load.urdf_reader import examine
from mbkit.model import Frame, Model, ModelBuilder
from mbkit.model.builder import with_loops
from mbkit.model.changes.joining import mounted
from mbkit.model.loops import LOOP_KINDS
from mbkit.model.parts import Loop
from mbkit.model.validation import scale_doubts

#: Values of `load(..., loops=)` beside True and False.
Loops = str | os.PathLike[str] | Sequence[Loop | Mapping[str, Any]]
#: Name of a TOML file's tables, one for each loop.
_TABLE: Final = "loop"
#: Largest file that is read, bytes.
_MAX_TOML_BYTES: Final = 1_000_000
_PARAMETERS: Final = {
    name: parameter.default is inspect.Parameter.empty
    for name, parameter in inspect.signature(ModelBuilder.add_loop).parameters.items()
    if name != "self"
}


def add_loops(model: Model, loops: Loops) -> Model:
    """Return a model with more loops, whose ends may stand on frames, such as links that were merged.

    Raises
    ------
    InputError
        No loops, or an argument that `ModelBuilder.add_loop` does not have or misses.
    LoadError
        A file that is missing, or is no TOML file of loops.
    ModelError
        All faults of the loops in one list: unknown bodies, kinds and wrong numbers.
    """
    entries: Sequence[Any]
    if isinstance(loops, (str, os.PathLike)):
        entries, where = read_loops(loops), os.fspath(loops)
    elif isinstance(loops, Sequence):
        entries, where = loops, "loops"
    else:
        raise InputError(
            f"loops: expected True, False, a TOML file, or a sequence of Loop objects or dicts, got {shown(loops)}"
        )
    arguments = [_arguments(one, f"{where}[{k}]") for k, one in enumerate(entries)]
    try:
        added = with_loops(model, [_on_bodies(model, one) for one in arguments])
    except ModelError as error:
        raise ModelError(where if where != "loops" else model.name, error.faults) from None
    names = ", ".join(repr(str(one["name"])) for one in arguments)
    return replace(added, notes=(*added.notes, f"loops given beside the file: {names}")) if arguments else added


def read_loops(path: str | os.PathLike[str]) -> list[Mapping[str, Any]]:
    """Return the tables ``[[loop]]`` of a TOML file, whose keys are arguments of `ModelBuilder.add_loop`."""
    file = Path(os.fspath(path))
    try:
        if file.stat().st_size > _MAX_TOML_BYTES:
            raise LoadError(f"{file}: expected a TOML file of loops, got {file.stat().st_size} bytes")
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise LoadError(f"{file}: {error.strerror or error}; loops= takes a TOML file, True, False or a list") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LoadError(f"{file}: not a TOML file: {error}") from None
    tables = content.get(_TABLE, [])
    if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables) or content.keys() - {_TABLE}:
        raise LoadError(f"{file}: expected tables [[{_TABLE}]] and nothing else, got {', '.join(content)}")
    if not tables:
        raise LoadError(f"{file}: no table [[{_TABLE}]]; write one for each loop")
    return tables


def _arguments(one: Any, what: str) -> dict[str, Any]:
    """Return the arguments of `add_loop` that a loop stands for."""
    if isinstance(one, Loop):
        return {f.name: getattr(one, f.name) for f in fields(one)}
    if not isinstance(one, Mapping):
        raise InputError(f"{what}: expected a Loop or a dict of add_loop's arguments, got {shown(one)}")
    for name in one:
        if name not in _PARAMETERS:
            near = nearest(name, _PARAMETERS) if isinstance(name, str) else []
            raise InputError(f"{what}: unknown argument {shown(name)}; add_loop takes {', '.join(near or _PARAMETERS)}")
    if missing := [name for name, needed in _PARAMETERS.items() if needed and name not in one]:
        kind, absent = one.get("kind"), f"{', '.join(missing)} missing"
        if "kind" in one and not (isinstance(kind, str) and kind in LOOP_KINDS):
            kinds = ", ".join(map(repr, LOOP_KINDS))
            raise InputError(f"{what}: unknown kind {shown(kind)}; there are {kinds}; and {absent}")
        raise InputError(f"{what}: {absent}")
    return dict(one)


def _on_bodies(model: Model, one: dict[str, Any]) -> dict[str, Any]:
    """Return a loop with ends on bodies where they are on frames, such as the links of a URDF that were merged."""
    bodies = {body.name for body in model.bodies}
    frames = {frame.name: frame for frame in model.frames if frame.name not in bodies}
    out = dict(one)
    for side in "ab":
        frame = frames.get(one[f"body_{side}"]) if isinstance(one[f"body_{side}"], str) else None
        if frame is not None:
            out |= _moved(frame, one, side)
    return out


def _moved(frame: Frame, one: dict[str, Any], side: str) -> dict[str, Any]:
    p, R = one.get(f"translation_{side}", np.zeros(3)), one.get(f"rotation_{side}")
    try:
        point = frame.translation + product(frame.rotation, np.array(p, dtype=np.float64))
        axes = frame.rotation if R is None else product(frame.rotation, np.array(R, dtype=np.float64))
    except (TypeError, ValueError):
        # The builder names their faults.
        return {f"body_{side}": frame.body}
    return {f"body_{side}": frame.body, f"translation_{side}": point, f"rotation_{side}": axes}


# `Path` drops one of the two slashes.
_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/[^\\]")
_PACKAGE: Final = "example-robot-data"
#: A package of modules, one a robot, that clone its repository into a cache.
_DESCRIPTIONS: Final = "robot_descriptions"
#: The path of a text, in messages.
_TEXT: Final = "the text given"
_USD: Final = "this is OpenUSD; export it as one of them"
#: Messages about files of other formats.
_OTHERS: Final = {
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _USD),
    ".mjb": "this is a compiled MuJoCo model; save it as XML (mujoco.mj_saveLastXML)",
}

# Common names of files with another stem: folder and stem.
_SHORT: Final = {
    "alexander": "alexander_description/alexander_v1.lowerBodyOnly",
    "anymal": "anymal_b_simple_description/anymal",
    "anymal_b": "anymal_b_simple_description/anymal",
    "anymal_b_kinova": "anymal_b_simple_description/anymal-kinova",
    "anymal_c": "anymal_c_simple_description/anymal",
    "asr_twodof": "asr_twodof_description/TwoDofs",
    "borinot": "borinot_description/borinot_flying_arm_2",
    "g1": "g1_description/g1_29dof_rev_1_0",
    "g1_with_hand": "g1_description/g1_29dof_with_hand_rev_1_0",
    "hector": "hector_description/quadrotor_base",
    "hextilt": "hextilt_description/hextilt_flying_arm_5",
    "hyq": "hyq_description/hyq_no_sensors",
    "solo8": "solo_description/solo",
    "talos": "talos_data/talos_reduced",
    "talos_arm": "talos_data/talos_left_arm",
    "talos_box": "talos_data/talos_reduced_box",
    "talos_full": "talos_data/talos_full_v2",
    "talos_full_box": "talos_data/talos_full_v2_box",
    "ur10": "ur_description/ur10_robot",
    "ur10_limited": "ur_description/ur10_joint_limited_robot",
    "ur3": "ur_description/ur3_robot",
    "ur3_limited": "ur_description/ur3_joint_limited_robot",
    "ur5": "ur_description/ur5_robot",
    "ur5_limited": "ur_description/ur5_joint_limited_robot",
}
_MAKERS: Final = {"franka": ["panda"], "pal": ["talos", "tiago"], "unitree": ["g1", "go2"], "universal": ["ur5"]}


def load(
    source: str | os.PathLike[str],
    *,
    floating_base: bool = False,
    mimic: Literal["reduce", "free"] = "reduce",
    nonphysical: Literal["error", "warn"] | None = None,
    gravity: ArrayLike | None = None,
    meshes: Literal["auto", "never"] = "auto",
    loops: bool | Loops = True,
    actuators: bool = False,
    mount: ArrayLike | None = None,
    xacro: Mapping[str, str] | None = None,
    stops: bool = False,
) -> Model:
    """Load a robot by name, or a URDF, MJCF or SDF: a file, its text, or a xacro file of a URDF.

    No other files are opened, except those that an MJCF includes, and the meshes that give a body of an MJCF its
    inertia. The model's ``notes`` name all decisions. Tendons of an MJCF act as springs and dampers, and the rotors of
    its actuators act too; a tendon whose inertia changes with q is refused. Limits are data, off in every engine,
    without `stops`.

    Parameters
    ----------
    source : str or path
        A robot of example-robot-data, such as ``"panda"`` or ``"ur_description/ur5_gripper"`` (`robots` lists them),
        or of robot_descriptions, such as ``"upkie_description"``, if that package has it in its cache; or a path, or
        the text of a URDF, MJCF or SDF, such as ROS's ``robot_description``. A text has no meshes to draw. Drake's
        parser reads an SDF of one model that is a tree, ``mbkit[drake]``; its meshes are not drawn.
    floating_base : bool
        Whether the base link moves freely, on a joint named ``"root_joint"``. The base of an SDF is held at its pose
        otherwise.
    mimic : {"reduce", "free"}
        What a URDF's mimic joints become: functions of the joints they follow, without coordinates of their own, or
        independent joints. An MJCF's equality of joints is a coupler, with the loops.
    nonphysical : {"error", "warn"}, optional
        What to do about inconsistent inertias: refuse them, or use them as written with a warning. By default robots
        by name warn, and files are refused. A negative mass is always refused.
    gravity : (3,) array_like, optional
        m/s², in world axes; by default the file's own (MJCF), else (0, 0, -9.81).
    meshes : {"auto", "never"}
        Whether an MJCF's meshes are read where a body has no other inertia, which MuJoCo's compiler then infers; with
        "never" such bodies are refused.
    loops : bool, path or sequence of Loop or dict
        Whether an MJCF's active <connect> and <weld> elements become loops, and that of joints a coupler,
        which holds exactly; without, they are left out and noted, as others always are. Or loops
        beside those of the file: dicts with the arguments of `ModelBuilder.add_loop`, `Loop` objects, or a TOML file
        with a table ``[[loop]]`` of these arguments for each. A URDF has no loops of its own. Their bodies may be
        frames too, such as links that were merged.
    actuators : bool
        Whether the actuators of an MJCF exert their force at zero control. By default they do not: τ is the whole
        force of the drives, so that ``inverse_dynamics`` at rest is gravity. With True a position servo becomes a
        spring of stiffness `kp` about zero and a damper `kv`, as MuJoCo computes at ``ctrl = 0``. Their rotors'
        inertia acts in both cases.
    mount : (4, 4) array_like, optional
        Where the robot's ground stands in the world, as a homogeneous matrix: a ceiling, a wall or a tilted base.
        `mbkit.spatial.pose` makes one. For a fixed base; q places a floating one.
    xacro : mapping of str to str, optional
        Arguments of a xacro file, as ``{"prefix": "left_"}``. The package xacro expands it, ``mbkit[xacro]``; such a
        file is a program that may read others, and its meshes are not drawn.
    stops : bool
        Whether the limits of the joints act as rigid stops, as by `Model.with_stops`.

    Returns
    -------
    Model
        Of a URDF with one body for every moving joint (links fixed to each other are merged and stay as frames), in
        Pinocchio's order; of an MJCF with its bodies and joints in the file's order.

    Raises
    ------
    UnknownNameError
        No robot has this name.
    LoadError
        The file, or one that it includes, is missing, or is not readable as a URDF, MJCF or SDF.
    ModelError
        The file or the added loops have faults; all of them are listed.

    Warns
    -----
    NonPhysicalWarning
        Some inertias are inconsistent and were used as written.
    MbkitWarning
        Masses or lengths are so far apart that engines lose digits in double precision.

    Examples
    --------
    >>> import mbkit as mb
    >>> mb.load("panda").nv
    8
    >>> mb.load("panda", mimic="free").nv
    9
    >>> rod = {"name": "rod", "kind": "distance", "body_a": "panda_link2", "body_b": "panda_link4", "length": 0.3}
    >>> mb.load("panda", loops=[rod]).loops[0].body_b
    'panda_link4'
    """
    for name, value, allowed, expected in (
        ("mimic", mimic, ("reduce", "free"), "'reduce' or 'free'"),
        ("nonphysical", nonphysical, ("error", "warn", None), "'error', 'warn' or None"),
        ("floating_base", floating_base, (True, False), "True or False"),
        ("meshes", meshes, ("auto", "never"), "'auto' or 'never'"),
        ("actuators", actuators, (True, False), "True or False"),
        ("stops", stops, (True, False), "True or False"),
    ):
        if not isinstance(value, (str, bool, np.bool_, NoneType)) or value not in allowed:
            raise InputError(f"{name}: expected {expected}, got {shown(value)}")
    added = None if isinstance(loops, (bool, np.bool_)) else loops
    if isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<"):
        path, by_name, file = Path(_TEXT), False, ""
        root = xml_reader.parse(source.encode("utf-8", "replace"), _TEXT)
    else:
        path, by_name = _locate(source)
        expands = path.suffix.lower() == ".xacro"
        # xacro's result is no file that others could read again.
        file = "" if expands else str(path.absolute())
        root = xml_reader.expanded(path, {} if xacro is None else xacro) if expands else xml_reader.read(path)
    if xacro is not None and path.suffix.lower() != ".xacro":
        raise InputError(f"xacro: arguments {shown(xacro)} for {path}, which is no .xacro file")
    policy = nonphysical or ("warn" if by_name else "error")
    if root.tag == "robot":
        # Pinocchio is imported only for a URDF.
        from mbkit.load.urdf import model_of

        reduce, lenient = mimic == "reduce", policy == "warn"
        urdf = examine(root, str(path), floating_base=floating_base, mimic_matters=reduce, lenient=lenient)
        g = (0.0, 0.0, -9.81) if gravity is None else gravity
        model = model_of(urdf, str(path), floating_base, mimic, policy, g)
    elif root.tag == "mujoco":
        from mbkit.load.mjcf import model_of_mjcf

        whole = xml_reader.with_includes(root, path)
        reads_loops = added is not None or bool(loops)
        model = model_of_mjcf(whole, path, floating_base, policy, gravity, meshes, reads_loops, bool(actuators))
    elif root.tag == "sdf":
        if str(path) != _TEXT and path.suffix.lower() != ".sdf":
            raise LoadError(f"{path}: this is SDF; give its file a name that ends in .sdf")
        read = from_above("sdf").model_of_sdf
        text = path.read_text("utf-8", "replace") if file else str(source)
        text = text.lstrip("\ufeff \t\r\n")
        model, file = read(root, text, str(path), floating_base, policy, gravity), ""
    else:
        raise xml_reader.unknown_root(path, root)
    if added is not None:
        model = add_loops(model, added)
    doubts = scale_doubts(model)
    if doubts:
        warn(f"{path}: engines may lose digits: {'; '.join(doubts)}", MbkitWarning)
    model = replace(model, notes=(*root.notes, *model.notes), source=file)
    model = model if mount is None else mounted(model, mount)
    return model.with_stops() if stops else model


def _locate(source: str | os.PathLike[str]) -> tuple[Path, bool]:
    """Return the file, and whether the source is a robot's name."""
    if not isinstance(source, (str, os.PathLike)):
        raise InputError(f"source: expected a robot's name or a path, got {shown(source)}")
    text = os.fspath(source)
    if not isinstance(text, str):
        raise InputError(f"source: expected a path of characters, got bytes {shown(text)}")
    if not text:
        raise InputError("source: expected a robot's name or a path, got an empty text")
    text = os.path.expanduser(text)
    if _URL.match(text) and not os.path.exists(text):
        raise LoadError(f"{text}: this is a URL, and mbkit reads local files; download it and give its path")
    if (other := _OTHERS.get(Path(text).suffix.lower())) is not None:
        raise LoadError(f"{text}: expected a URDF or MJCF file, {other}")
    if isinstance(source, str):
        looks_like_path = text.lower().endswith((".urdf", ".xml", ".mjcf", ".xacro", ".sdf"))
        robot = None if looks_like_path else find(text)
        if robot is not None:
            return robot.path, True
        if not looks_like_path and not os.path.exists(text):
            return described(text), True
    return Path(text), False


# Robots by name


@dataclass(frozen=True)
class Robot:
    """A URDF of example-robot-data; the file is read at the first use of its size.

    Attributes
    ----------
    name : str
        Folder and file, such as ``"panda_description/panda"``.
    aliases : tuple of str
        Shorter names, the usual one first.
    path : pathlib.Path
    """

    name: str
    aliases: tuple[str, ...]
    path: Path

    def __repr__(self) -> str:
        return f"<Robot {self.aliases[0] if self.aliases else self.name}: {self.name}>"

    @cached_property
    def _facts(self) -> tuple[int | None, int | None, float | None, str | None]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", MbkitWarning)
                model = load(self.name)
        except MbkitError as error:
            return None, None, None, "; ".join(error.faults) if isinstance(error, ModelError) else str(error)
        return model.nq, model.nv, model.mass, None

    @property
    def nq(self) -> int | None:
        """Number of coordinates, mimic joints reduced; None if it does not load."""
        return self._facts[0]

    @property
    def nv(self) -> int | None:
        """Number of velocities; None if it does not load."""
        return self._facts[1]

    @property
    def mass(self) -> float | None:
        """Total mass in kg; None if it does not load."""
        return self._facts[2]

    @property
    def reason(self) -> str | None:
        """Why it does not load; None if it does."""
        return self._facts[3]

    @property
    def _spellings(self) -> tuple[str, ...]:
        """The names that mean this robot, its usual one first."""
        folder, stem = self.name.split("/")
        short = folder.removesuffix("_description").removesuffix("_data")
        return (*self.aliases, self.name, f"{short}/{stem}")


def robots() -> tuple[Robot, ...]:
    """Return a record of every robot of example-robot-data, by name.

    Returns
    -------
    tuple of Robot
        Each with ``name``, ``aliases``, ``path``, and ``nq``, ``nv``, ``mass`` or the ``reason`` why it does not load;
        the last four load the file at their first use.

    Raises
    ------
    LoadError
        example-robot-data is not installed.
    """
    return _table()[0]


def find(name: str) -> Robot | None:
    """Return the robot of this name, or None; case and ``-`` or ``_`` do not matter."""
    return _table()[1].get(_key(name))


def canonical(name: str) -> str | None:
    """Return a robot's name as it is listed, whatever its case here; None for any other text."""
    robot = find(name)
    return next((s for s in robot._spellings if _key(s) == _key(name)), None) if robot else None


def unknown(name: str) -> UnknownNameError:
    """Return the error for a name that is neither a robot nor a path."""
    modules = _modules()
    known = sorted({x for r in robots() for x in (r.name, r._spellings[0])} | _SHORT.keys() | modules.keys())
    # Packages of descriptions call a robot's folder so, and other names begin with the maker's.
    stem = re.sub("(_mj|_moveit)?_description$", "", name)
    words = _key(stem).replace(" ", "_").split("_") if "/" not in name else [""]
    folder = find(stem)
    near = [folder.name] if folder else [x for x in words if find(x)] or _MAKERS.get(words[0], [])
    other = "" if modules or not name.endswith("_description") else f"; names of {_DESCRIPTIONS} need that package"
    hint = f"(a path to a file ends in .urdf or .xml; mbkit robots lists all names{other})"
    return UnknownNameError("robot", name, known, hint, near=near)


def _modules() -> dict[str, Path]:
    """Return the modules of robot_descriptions by name; none where it is not installed."""
    spec = find_spec(_DESCRIPTIONS)
    folders = spec.submodule_search_locations or () if spec else ()
    return {p.stem: p for folder in folders for p in Path(folder).glob("[!_]*_description.py")}


def described(name: str) -> Path:
    """Return a robot's file in the cache of robot_descriptions; `UnknownNameError` where that has no such robot.

    Nothing is fetched: its module runs with a function that looks into the cache, in the place of the one that clones.
    """
    module = _key(name)
    if (file := _modules().get(module)) is None:
        raise unknown(name)
    from robot_descriptions._repositories import REPOSITORIES

    cache = os.path.expanduser(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions"))

    def cached(repository: str, commit: str | None = None) -> str:
        place = REPOSITORIES[repository].cache_path
        return os.path.join(cache, f"{place}-{commit}/{place}" if commit else place)

    def importing(what: str, *others: Any) -> Any:
        return SimpleNamespace(clone_to_cache=cached) if what == "_cache" else builtins.__import__(what, *others)

    names: dict[str, Any] = {"__builtins__": vars(builtins) | {"__import__": importing}, "__package__": _DESCRIPTIONS}
    pull = f"python -m {_DESCRIPTIONS} pull {module}"
    try:
        exec(compile(file.read_text("utf-8"), str(file), "exec"), names)
    except OSError:
        # A module that mends its file opens it.
        names = {}
    path = Path(names.get("URDF_PATH") or names.get("MJCF_PATH") or names.get("XACRO_PATH") or "")
    if not path.is_file():
        raise LoadError(f"{name}: its files are not in the cache of {_DESCRIPTIONS}, {cache}; `{pull}` fetches them")
    if path.suffix == ".xacro":
        raise LoadError(
            f"{name}: {_DESCRIPTIONS} makes its URDF by xacro; `{pull}` prints the path, which mb.load takes"
        )
    return path


def _key(name: str) -> str:
    return name.lower().replace("-", "_")


@lru_cache(maxsize=1)
def _table() -> tuple[tuple[Robot, ...], dict[str, Robot]]:
    """Return every URDF on the package's file list, in order and by all its names."""
    try:
        files = importlib.metadata.files(_PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        files = None
    if files is None:
        raise LoadError(f"robots by name come from {_PACKAGE}, which is not installed; pip install {_PACKAGE}")
    urdfs = sorted(
        (f"{file.parts[file.parts.index('robots') + 1]}/{file.stem}", file.stem, Path(str(file.locate())))
        for file in files
        if file.suffix == ".urdf" and "robots" in file.parts[:-2]
    )
    stems = Counter(_key(stem) for _, stem, _ in urdfs)
    short = {_key(alias) for alias in _SHORT}
    out, by_key = [], dict[str, Robot]()
    for name, stem, path in urdfs:
        own = (stem,) if stems[_key(stem)] == 1 and _key(stem) not in short else ()
        out.append(Robot(name, (*(a for a, full in _SHORT.items() if full == name), *own), path))
    for robot in out:
        for spelling in (robot.name, robot._spellings[-1], *robot.aliases):
            by_key.setdefault(_key(spelling), robot)
    return tuple(out), by_key
