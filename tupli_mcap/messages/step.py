"""The layout of a recording's messages, derived from its spaces and the dtypes decided at the first step.

Writer and reader both derive every schema, offset and dtype with `StepLayout`; a reader refuses a file whose schema
text differs.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import DType
from tupli_mcap.errors import FormatError, SpaceError
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.layout import PREFIX, SEPARATOR, ImageLayout, MessageLayout, image_layout
from tupli_mcap.messages.variable.codec import VariableField
from tupli_mcap.spaces.leaves import (
    ROS_TYPES,
    Leaf,
    NameRegistry,
    camel,
    flatten_space,
    leaves_in,
    own_space,
    space_of,
    structure,
)
from tupli_mcap.spaces.space_json import space_from_json, space_to_json

STEP_SCHEMA = "tupli_mcap/msg/Step"
FINAL_STATE_SCHEMA = "tupli_mcap/msg/FinalState"
MAX_FRAMES = 256  # of a stack: a row takes at most this many times as many bytes in memory as in the file
Stack = str | list[str]  # `name`, or `[name, "last"]`
_RESERVED = ("episode", "step", "terminal", "timeout", "env")
_GIVEN = (
    "observation_space", "action_space", "reward_space", "state", "action", "reward",
    "dtypes", "inner_dtypes", "stacks", "nest_state", "nest_action", "nest_reward",
)  # fmt: skip
"""What the constructor of a layout sets; all else follows from it."""
_U32, _BOOL = np.dtype(np.uint32), np.dtype(np.bool_)


class StepLayout:
    """Leaves, stored dtypes and message layouts of `/step`, `/final_state` and the image channels.

    Args:
        observation_space, action_space: of the environment; spaces of texts of other libraries become Texts.
        reward_space: None for a float64.
        dtypes: ROS name of a constant leaf -> stored dtype; other leaves keep the declared one.
        inner_dtypes: ROS name of a variable leaf -> path in the leaf -> dtype name.
        stacks: leaves that are stacks of frames: a name if the first axis holds the frames, `[name, "last"]` if the
            last one does. A leaf whose values are not uint8 is stored as an array all the same.

    Raises:
        SpaceError: a space cannot be recorded; the message has the path of the leaf.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        reward_space: gym.Space[Any] | None = None,
        dtypes: Mapping[str, DType] | None = None,
        inner_dtypes: Mapping[str, Mapping[str, str]] | None = None,
        stacks: Collection[Stack] = (),
    ) -> None:
        self.observation_space, self.action_space = own_space(observation_space), own_space(action_space)
        self.inner_dtypes = {name: dict(found) for name, found in (inner_dtypes or {}).items() if found}
        self.reward_space = reward_space
        names = NameRegistry(_RESERVED)
        reward = reward_space if reward_space is not None else gym.spaces.Box(-np.inf, np.inf, (), np.float64)
        self.state = flatten_space(self.observation_space, "state", names, images=True)
        self.action = flatten_space(self.action_space, "action", names)
        self.reward = flatten_space(reward, "reward", names)
        given = dict(dtypes or {})
        self.dtypes: dict[str, DType] = {
            leaf.name: given.pop(leaf.name, leaf.dtype) for leaf in self.leaves if leaf.dtype is not None
        }
        if given:
            raise SpaceError(
                f"dtypes are given for {sorted(given)}, which are not leaves of constant size in these spaces"
            )
        self.state = [_as_stored(leaf, self.dtypes.get(leaf.name), stacks) for leaf in self.state]
        self.stacks = [stack_of(leaf) for leaf in self.state if leaf.kind == "stack"]
        self.nest_state = structure(self.observation_space)
        self.nest_action = structure(self.action_space)
        self.nest_reward = structure(reward)

    def without(self, fields: Collection[str]) -> StepLayout:
        """The same layout with an empty space for "states", for "actions", or for both."""
        nothing = gym.spaces.Dict({})
        left_out = [leaf.name for leaf in self.state if "states" in fields]
        left_out += [leaf.name for leaf in self.action if "actions" in fields]
        return StepLayout(
            nothing if "states" in fields else self.observation_space,
            nothing if "actions" in fields else self.action_space,
            self.reward_space,
            {name: dtype for name, dtype in self.dtypes.items() if name not in left_out},
            {name: found for name, found in self.inner_dtypes.items() if name not in left_out},
            [] if "states" in fields else self.stacks,
        )

    def only(self, parts: Collection[str]) -> StepLayout:
        """A layout of columns with only some parts of the state, such as "state.arm", or of the action; with all of
        that of which no part is given. Messages are decoded by the whole layout.

        SpaceError if there is no such part, or if it is in a Tuple or an array.
        """
        if not parts:
            return self
        made = StepLayout.__new__(StepLayout)
        vars(made).update({name: value for name, value in vars(self).items() if name in _GIVEN})
        if some := [part for part in parts if part.startswith("state")]:
            made.state = leaves_in(some, self.state)
            made.observation_space = space_of(self.observation_space, made.state)
            made.nest_state = structure(made.observation_space)
        if some := [part for part in parts if part.startswith("action")]:
            made.action = leaves_in(some, self.action)
            made.action_space = space_of(self.action_space, made.action)
            made.nest_action = structure(made.action_space)
        return made

    @property
    def leaves(self) -> list[Leaf]:
        return [*self.state, *self.action, *self.reward]

    @cached_property
    def images(self) -> list[Leaf]:
        """The leaves of the state that have a channel of their own."""
        return [leaf for leaf in self.state if leaf.apart]

    @cached_property
    def step_leaves(self) -> list[Leaf]:
        """The leaves that `/step` itself holds, in message order."""
        return [leaf for leaf in self.leaves if not leaf.apart]

    @cached_property
    def final_leaves(self) -> list[Leaf]:
        """The leaves of `/final_state`: those of `/step` first, at the same offsets, then the images."""
        return [leaf for leaf in self.state if not leaf.apart] + self.images

    @cached_property
    def constant(self) -> bool:
        """True if every step message has the same size."""
        return all(leaf.kind != "variable" for leaf in self.leaves)

    @cached_property
    def variable(self) -> dict[str, VariableField]:
        """Codecs of the leaves of variable size, by ROS name."""
        taken: set[str] = set()  # names of nested messages are unique in a schema
        return {
            leaf.name: VariableField(
                leaf.space,
                leaf.name,
                type_prefix=camel(leaf.name),
                path=leaf.path,
                taken=taken,
                dtypes=self.inner_dtypes.get(leaf.name),
            )
            for leaf in self.leaves
            if leaf.kind == "variable"
        }

    def codec(self, leaf: Leaf) -> VariableField:
        """Encodes and decodes values of a leaf, of constant size, too."""
        if leaf.kind == "variable":
            return self.variable[leaf.name]
        return VariableField(leaf.space, leaf.name, path=leaf.path, dtypes={"": self.dtypes[leaf.name].name})

    @cached_property
    def step_message(self) -> MessageLayout:
        """Offsets of `/step`; only for constant layouts."""
        return MessageLayout.of(
            [("episode", _U32, ()), ("step", _U32, ())]
            + [(leaf.name, self.dtypes[leaf.name], leaf.shape) for leaf in self.step_leaves]
            + [("terminal", _BOOL, ()), ("timeout", _BOOL, ())]
        )

    @cached_property
    def state_end(self) -> int:
        """Bytes of a `/step` record up to the end of its state; only for constant layouts."""
        names = {leaf.name for leaf in self.state}
        ends = [field.offset + field.nbytes for field in self.step_message.fields if field.name in names]
        return BODY + max(ends, default=8)

    @cached_property
    def tells_episodes(self) -> bool:
        """True if rows of `/step` hold all that an episode is: its return is the sum of a field, and its final state
        fits into the row after its last one."""
        is_plain = self.constant and self.reward_space is None and not self.images
        return is_plain and self.state_end > PREFIX

    @cached_property
    def final_message(self) -> MessageLayout:
        """Offsets of `/final_state`, images included; only for constant layouts."""
        return MessageLayout.of(
            [("episode", _U32, ()), ("env", _U32, ())]
            + [(leaf.name, self.dtypes[leaf.name], leaf.shape) for leaf in self.final_leaves]
        )

    @cached_property
    def image_messages(self) -> dict[str, ImageLayout]:
        """Layouts of the image channels, by ROS name of the leaf."""
        return {leaf.name: image_layout(leaf) for leaf in self.images}

    def reward_total(self, reward: Any) -> float:
        """The sum of a reward's numbers, which it adds to the return."""
        if self.reward_space is None:
            return float(reward)
        numbers = [leaf.get(reward) for leaf in self.reward if leaf.kind != "variable"]
        return float(sum(np.sum(number, dtype=np.float64) for number in numbers))

    @cached_property
    def step_schema(self) -> str:
        """The ros2msg text of `/step`."""
        head = ["uint32 episode\n", "uint32 step\n"]
        return self._text(head, self.step_leaves, ["bool terminal\n", "bool timeout\n"])

    @cached_property
    def final_schema(self) -> str:
        """The ros2msg text of `/final_state`."""
        return self._text(["uint32 episode\n", "uint32 env\n"], self.final_leaves, [])

    def _text(self, head: list[str], leaves: Sequence[Leaf], tail: list[str]) -> str:
        lines, definitions = list(head), []
        for leaf in leaves:
            if leaf.kind == "variable":
                codec = self.variable[leaf.name]
                lines.append(f"{codec.field_type} {leaf.name}\n")
                definitions += codec.definitions
            elif 0 not in leaf.shape:
                count = "" if leaf.shape == () else f"[{leaf.size}]"  # dimensions are flattened (C order)
                lines.append(f"{ROS_TYPES[self.dtypes[leaf.name].name]}{count} {leaf.name}\n")
        nested = [f"{SEPARATOR}MSG: {name}\n{text}" for name, text in definitions]
        return "".join([*lines, *tail, *nested])

    def to_metadata(self) -> dict[str, str]:
        """The layout as channel metadata; `from_metadata` rebuilds it."""
        reward = "" if self.reward_space is None else jsonvalue.dumps(space_to_json(self.reward_space))
        return {
            "observation_space": jsonvalue.dumps(space_to_json(self.observation_space)),
            "action_space": jsonvalue.dumps(space_to_json(self.action_space)),
            "reward_space": reward,
            "dtypes": jsonvalue.dumps({name: dtype.name for name, dtype in self.dtypes.items()}),
            "inner_dtypes": jsonvalue.dumps(self.inner_dtypes),
            **({"stacks": jsonvalue.dumps(self.stacks)} if self.stacks else {}),
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> StepLayout:
        """Rebuilds a layout from a channel's metadata; raises FormatError if the metadata are incomplete or describe no
        layout."""
        reward_text = _entry(metadata, "reward_space")
        reward = space_from_json(jsonvalue.loads(reward_text)) if reward_text else None
        names = jsonvalue.loads(_entry(metadata, "dtypes"))
        if not isinstance(names, dict) or not all(name in ROS_TYPES for name in names.values()):
            raise FormatError(
                f"channel metadata 'dtypes': expected ROS names with NumPy dtypes, found {names!r:.200}"
            )
        inner = jsonvalue.loads(_entry(metadata, "inner_dtypes"))
        if not isinstance(inner, dict) or not all(isinstance(found, dict) for found in inner.values()):
            raise FormatError(
                f"channel metadata 'inner_dtypes': expected paths with dtypes, found {inner!r:.200}"
            )
        stacks = jsonvalue.loads(metadata.get("stacks", "[]"))
        if not isinstance(stacks, list) or not all(map(_is_stack, stacks)):
            raise FormatError(
                f"channel metadata 'stacks': expected a list of ROS names, each alone or in [name, 'last'], "
                f"found {stacks!r:.200}"
            )
        try:
            layout = cls(
                space_from_json(jsonvalue.loads(_entry(metadata, "observation_space"))),
                space_from_json(jsonvalue.loads(_entry(metadata, "action_space"))),
                reward,
                {name: np.dtype(text) for name, text in names.items()},
                inner,
                stacks,
            )
            if layout.stacks != stacks:
                raise FormatError(
                    f"channel metadata 'stacks': expected leaves of the state, found {stacks!r:.200}"
                )
            _ = layout.variable
            return layout
        except SpaceError as err:
            raise FormatError(f"channel metadata describes spaces that cannot be recorded: {err}") from err


def can_stack(leaf: Leaf) -> bool:
    """Whether a leaf may be a stack of frames: uint8 of stored shape (frames, H, W) or (frames, H, W, 1|3|4)."""
    if leaf.dtype != np.uint8 or len(leaf.shape) not in (3, 4) or 0 in leaf.shape:
        return False
    frames, *picture = leaf.stored_shape
    return 2 <= frames <= MAX_FRAMES and (len(picture) == 2 or picture[2] in (1, 3, 4))


def stack_of(leaf: Leaf) -> Stack:
    """The entry of a stack in `stacks`."""
    return [leaf.name, "last"] if leaf.frames_last else leaf.name


def _is_stack(entry: Any) -> bool:
    if isinstance(entry, list):
        return len(entry) == 2 and all(isinstance(part, str) for part in entry) and entry[1] == "last"
    return isinstance(entry, str)


def _as_stored(leaf: Leaf, dtype: DType | None, stacks: Collection[Stack]) -> Leaf:
    """The leaf as a stack if `stacks` has it, else as it is."""
    if dtype != np.uint8:  # viewers show no image of other values: it is stored as an array
        return replace(leaf, kind="array") if leaf.kind == "image" else leaf
    stack = replace(leaf, kind="stack", frames_last=leaf.name not in stacks)
    if stack_of(stack) not in stacks:
        return leaf
    if not can_stack(stack):
        raise SpaceError(
            f"{leaf.path}: expected 2 to {MAX_FRAMES} uint8 frames of shape (H, W) or (H, W, 1, 3 or 4) "
            f"along the {'last' if stack.frames_last else 'first'} axis of a stack, found {leaf.space}"
        )
    return stack


def _entry(metadata: Mapping[str, str], key: str) -> str:
    if key not in metadata:
        raise FormatError(f"channel metadata: expected the key {key!r}, found {sorted(metadata)}")
    return metadata[key]
