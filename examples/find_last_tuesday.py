"""Record three runs, and find one of them again: by its time, its returns and its metadata."""

import gymnasium as gym

import tupli_mcap


def record(policy, gain):
    """Records five episodes; pushes the cart the way the pole leans and turns."""
    with tupli_mcap.RecordEpisodes(
        gym.make("CartPole-v1"), "runs/", name=policy, metadata={"gain": gain}, tags=["by hand"]
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

# on the command line: tupli-mcap ls runs/ --filter 'run.started > "7d ago" and run.metadata.gain > 0'
everything = tupli_mcap.open("runs/")
print(everything)
recent = everything.filter('run.started > "7d ago" and run.metadata.gain > 0')
found = recent.filter("return > 150")
print("found", len(found), "episodes of", {episode.run.name for episode in found})

run = found[0].run
print(f"{run.name!r}: {run.environment}, started {run.started}, {run.metadata}, tags {run.tags}")
print(
    "made by",
    " ".join(run.command),
    "at commit",
    run.git.get("commit", "none"),
    "in",
    found[0].recording.name,
)
