"""Three runs, one of which is to be found again: by its time, its returns and what was noted of it."""

import gymnasium as gym

import tupli_mcap


class Note(tupli_mcap.EpisodeMetadataCallback):
    """The same metadata for every episode of a run."""

    def __init__(self, **metadata):
        self.metadata = metadata

    def reset(self):
        pass

    def __call__(self, step):
        return self.metadata


def record(policy, gain):
    with tupli_mcap.RecordEpisodes(
        gym.make("CartPole-v1"), "runs/", metadata_callback=Note(policy=policy, gain=gain)
    ) as env:
        for seed in range(5):
            state, _ = env.reset(seed=seed)
            done = False
            while not done:
                state, _, terminated, truncated, _ = env.step(int(state[2] + gain * state[3] > 0))
                done = terminated or truncated


record("angle", 0.0)
record("angle and speed", 0.5)
record("wrong sign", -0.3)

everything = tupli_mcap.open("runs/")
print(everything, "\nkeys:", *everything.keys, "\n")

recent = everything.filter('ended >= "7d ago" and ended <= "today"')
found = recent.filter("return > 150 and metadata.gain > 0")
print(found, "of", {episode.metadata["policy"] for episode in found})
print(*{episode.recording.name for episode in found}, "\n")

table = everything.to_pandas("episodes")
print(
    table.groupby("metadata.policy").agg(
        episodes=("return", "size"), mean_return=("return", "mean"), last=("ended", "max")
    )
)
