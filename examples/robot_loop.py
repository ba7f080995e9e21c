"""Record a robot in its own control loop: two cameras, joints and an instruction, without a Gymnasium environment.

python examples/robot_loop.py [DIRECTORY]
"""

from __future__ import annotations

import string
import sys
from pathlib import Path

import numpy as np
from gymnasium import spaces

import tupli_mcap

OBSERVATIONS = spaces.Dict(
    {
        "front": spaces.Box(0, 255, (48, 64, 3), np.uint8),
        "wrist": spaces.Box(0, 255, (32, 32, 3), np.uint8),
        "joints": spaces.Box(-3.2, 3.2, (6,), np.float32),
        "instruction": spaces.Text(80, charset=string.ascii_lowercase + " "),
    }
)
ACTIONS = spaces.Box(-1, 1, (7,), np.float32)  # six joint velocities, and the gripper
TASKS = ["put the red cup on the tray", "open the drawer", "pick up the screw"]


class Robot:
    """Stands in for the driver of a real robot."""

    def __init__(self) -> None:
        self._joints = np.zeros(6, np.float32)

    def observe(self, instruction: str) -> dict[str, object]:
        """Reads the sensors."""
        return {
            "front": self._picture(48, 64, self._joints[:2]),
            "wrist": self._picture(32, 32, self._joints[3:5]),
            "joints": self._joints.copy(),
            "instruction": instruction,
        }

    @staticmethod
    def _picture(high: int, wide: int, place: np.ndarray) -> np.ndarray:
        """A bright square on a dark table, where two joints say."""
        x, y = (np.clip(0.5 + place, 0, 1) * (wide - 8, high - 8)).astype(int)
        picture = np.full((high, wide, 3), (40, 44, 52), np.uint8)
        picture[y : y + 8, x : x + 8] = (240, 150, 40)
        return picture

    def act(self, action: np.ndarray) -> float:
        """Moves for one period; returns the motor current (A)."""
        self._joints += 0.05 * action[:6]
        return float(np.abs(action).sum())


def main(directory: Path) -> None:
    robot, rng = Robot(), np.random.default_rng(1)
    path = directory / "robot.mcap"
    with tupli_mcap.EpisodeWriter(
        path, OBSERVATIONS, ACTIONS, environment="arm", step_seconds=1 / 50, mode="a"
    ) as writer:
        for i in range(6):
            task = TASKS[i % len(TASKS)]
            writer.begin(metadata={"operator": "Ann", "task": task})
            observation = robot.observe(task)
            for step in range(20):
                action = rng.uniform(-1, 1, 7).astype(np.float32)
                current = robot.act(action)
                done = step == 19
                # from here on this step is safe, whatever happens to the process
                writer.step(observation, action, float(done), terminal=done, info={"current": current})
                observation = robot.observe(task)
            if i == 3:
                writer.discard()  # the operator bumped into the table
            else:
                writer.end(observation, metadata={"success": i % 2 == 0})

    dataset = tupli_mcap.open(path)
    print(dataset)
    for episode in dataset.filter("metadata.success"):
        print(episode, episode.metadata["task"], episode.states["joints"][-1].round(2))
    first = dataset[0]
    print("front camera:", first.states["front"].shape, "final state:", sorted(first.final_state))
    print("mean current:", np.mean([info["current"] for info in first.infos]))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
