"""Balance the pole yourself: a and d push it, q stops. Without a terminal, a scripted player takes your place."""

import contextlib
import select
import sys
import termios
import time
import tty

import gymnasium as gym

import tupli_mcap


@contextlib.contextmanager
def keys():
    """Lets single keys be read, and puts the terminal back as it was."""
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def human(state, action):
    """The action of the key that was pressed last; without a key, the action before."""
    position, _, angle, _ = state
    lean = "/" if angle > 0.02 else "\\" if angle < -0.02 else "|"
    print(f"\r{' ' * round(30 + 12 * position)}{lean}".ljust(70), end="", flush=True)
    time.sleep(0.05)
    key = sys.stdin.read(1) if select.select([sys.stdin], [], [], 0)[0] else ""
    return {"a": 0, "d": 1, "q": None}.get(key, action)


def script(state, action):
    return int(state[2] + 0.3 * state[3] > 0)


def play(player, episodes=3):
    with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1", max_episode_steps=300), "played/") as env:
        for _ in range(episodes):
            state, _ = env.reset()
            action, done = 0, False
            while not done and (action := player(state, action)) is not None:
                state, _, terminated, truncated, _ = env.step(action)
                done = terminated or truncated
    return env.path


if sys.stdin.isatty():
    with keys():
        path = play(human)
else:
    path = play(script)

print(f"\nrecorded {path}")
for episode in tupli_mcap.open(path):
    print(f"  {episode.number}: balanced for {len(episode)} steps, then {episode.end}")
