"""Judges an exported data set with LeRobot itself: load, DataLoader, one training step of ACT, delete, split, merge, and load again.

    check.py DATA_SET SCRATCH

Prints a line for each point. Ends with 1 at the first that does not hold.
"""

import json
import math
import os
import pathlib
import sys

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("HF_HOME", str(pathlib.Path(sys.argv[2]) / "hub"))

import pandas
import torch
from lerobot.configs.types import FeatureType
from lerobot.datasets import dataset_tools
from lerobot.utils.feature_utils import dataset_to_policy_features
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

# Frames that one training step looks at, and actions that ACT plans. Small, for a machine without a GPU.
BATCH, CHUNK = 4, 8
# Numbers that each statistic has.
NUMBERS = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


def holds(what, condition):
    print(("ok    " if condition else "FAILS ") + what, flush=True)
    if not condition:
        sys.exit(1)


def numbers(value):
    """All numbers in nested lists."""
    if isinstance(value, list):
        for inner in value:
            yield from numbers(inner)
    else:
        yield value


def load(root, **more):
    return LeRobotDataset("decant/check", root=root, video_backend="pyav", **more)


def check_statistics(root, what):
    stats = json.loads((root / "meta" / "stats.json").read_text())
    features = json.loads((root / "meta" / "info.json").read_text())["features"]
    missing = [f"{name}: {NUMBERS - set(stats.get(name, {}))}" for name in features if NUMBERS - set(stats.get(name, {}))]
    holds(f"{what}: stats.json has q01 to q99 of every column {missing or ''}", not missing)
    holds(f"{what}: every statistic is finite", all(math.isfinite(n) for n in numbers([list(s.values()) for s in stats.values()])))


def check_rows(root, what):
    table = pandas.concat(pandas.read_parquet(f) for f in sorted((root / "data").rglob("*.parquet")))
    values = [n for name in ("observation.state", "action") for row in table[name] for n in row]
    holds(f"{what}: no number of {len(table)} rows is NaN", all(math.isfinite(n) for n in values))
    holds(f"{what}: action is at least two wide", all(len(row) >= 2 for row in table["action"]))
    return table


def train(root):
    """One step of ACT, from the DataLoader to the optimiser. Returns the loss."""
    meta = load(root).meta
    times = [i / meta.fps for i in range(CHUNK)]
    data = load(root, delta_timestamps={"action": times})
    features = dataset_to_policy_features(meta.features)
    outputs = {k: f for k, f in features.items() if f.type is FeatureType.ACTION}
    inputs = {k: f for k, f in features.items() if k not in outputs}
    config = ACTConfig(
        input_features=inputs, output_features=outputs, chunk_size=CHUNK, n_action_steps=CHUNK, pretrained_backbone_weights=None,
        dim_model=64, n_heads=4, dim_feedforward=128, n_encoder_layers=1, device="cpu", push_to_hub=False,
    )
    policy = ACTPolicy(config)
    before, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
    policy.train()
    optimiser = torch.optim.AdamW(policy.parameters(), lr=1e-4)
    loader = torch.utils.data.DataLoader(data, batch_size=BATCH, shuffle=True, num_workers=0, generator=torch.Generator().manual_seed(1))
    loss, _ = policy.forward(before(next(iter(loader))))
    loss.backward()
    optimiser.step()
    return loss.item()


def main():
    root, scratch = map(pathlib.Path, sys.argv[1:3])
    torch.manual_seed(1)
    data = load(root)
    episodes, frames = data.meta.total_episodes, len(data)
    holds(f"it loads: {episodes} episodes, {frames} frames", episodes >= 3 and frames == data.meta.total_frames)
    check_rows(root, "export")
    check_statistics(root, "export")
    item = data[frames // 2]
    holds(f"a picture has the shape {tuple(item['observation.images.camera'].shape)}", item["observation.images.camera"].shape[0] == 3)
    holds("the mask has lost and unmeasured frames", not all(data.hf_dataset["known"][i].all() for i in range(frames)))
    loss = train(root)
    holds(f"one step of ACT: loss {loss:.4f}", math.isfinite(loss))

    fewer = dataset_tools.delete_episodes(data, [1], output_dir=scratch / "fewer", repo_id="decant/fewer")
    holds(f"delete_episodes leaves {fewer.meta.total_episodes}", fewer.meta.total_episodes == episodes - 1)
    parts = dataset_tools.split_dataset(data, {"train": list(range(episodes - 1)), "check": [episodes - 1]}, output_dir=scratch / "split")
    sizes = {name: part.meta.total_episodes for name, part in parts.items()}
    holds(f"split_dataset makes {sizes}", sizes == {"train": episodes - 1, "check": 1})
    merged = dataset_tools.merge_datasets(list(parts.values()), "decant/merged", output_dir=scratch / "merged")
    holds(f"merge_datasets has {merged.meta.total_frames} frames again", merged.meta.total_frames == frames)
    for name, part in [("deleted", fewer), ("split", parts["train"]), ("merged", merged)]:
        table = check_rows(part.root, name)
        check_statistics(part.root, name)
        again = load(part.root)
        picture = again[len(again) - 1]["observation.images.camera"]
        holds(f"{name}: loads again, and its last picture is there", len(again) == len(table) and bool(torch.isfinite(picture).all()))
    loss = train(merged.root)
    holds(f"merged: one step of ACT: loss {loss:.4f}", math.isfinite(loss))


if __name__ == "__main__":
    main()
