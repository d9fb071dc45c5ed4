"""Train the predictor `social` on synthetic crowds, and write mcaptrack/predictors/trained/social.safetensors.

The crowds are those of `mcaptrack train synthetic` (social forces) with more of what people do together: in each scene
up to 70 % walk in groups of two to five, scenes are dense or sparse, people go anywhere, between five gates, or in two
opposite flows, and come back on the other side when they leave. Their positions are given the noise and the gaps of
trackers. `red` predicts everybody; the network learns to correct that from those who are near. `red` is not changed.
No recording is used. Needs torch and a GPU; one network takes two minutes of an H100 and sixteen cores.

    python3 tools/train_social.py -o OUT [--seeds 1 2 3] [--batches 64] [--epochs 10] [--ablation]

OUT/social_SEED.safetensors are the networks; `--ablation` also trains them without other people, and without taking
over their displacements. The one with the smallest error on synthetic crowds is that which comes with mcaptrack.

Letters: S scenes, M people, T steps, B tracks, K people near each of them, F features.
"""

from __future__ import annotations

import argparse
import os
import time
from multiprocessing import Pool
from pathlib import Path

import missing_extension  # noqa: F401
import numpy as np
import torch
from torch import nn

from mcaptrack import __version__
from mcaptrack.extensions.training.windows import ar1
from mcaptrack.geometry.arrays import taken
from mcaptrack.geometry.mixtures import mahalanobis_squared
from mcaptrack.predictors import social
from mcaptrack.predictors.forecast import PeopleSeen
from mcaptrack.predictors.weights import SHIPPED, Weights, load, save
from mcaptrack.sources import walks

STEPS, PAST, STEP_S = 12, 8, 0.4
SCENES, PEOPLE, K = walks.SCENES, walks.PEOPLE, social.MOST_PEOPLE
#: Steps of 0.4 s that a crowd is recorded, and how often a frame of them is taken.
LENGTH, STRIDE = 110, 4
HIDDEN, DENSE = 48, 64
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
RED = load(SHIPPED / "red.safetensors")


class Crowd(walks.Crowd):
    """S scenes of M people: of each scene a share of groups, and a kind: anywhere, gates, two flows."""

    @classmethod
    def begin(cls, rng: np.random.Generator) -> Crowd:
        crowd = cls.start(rng)
        shape, scene = crowd.pace.shape, np.arange(SCENES)[:, None]
        crowd.kind = rng.choice(3, (SCENES, 1), p=(0.55, 0.25, 0.2))
        side = np.exp(rng.uniform(np.log(14), np.log(100), (SCENES, 1)))
        crowd.side_m = np.where(crowd.kind == 1, np.maximum(side, 35), side)
        share = np.maximum(rng.uniform(-0.1, 0.7, (SCENES, 1)), 0)
        joins, most = rng.random(shape) < share, rng.integers(1, 5, shape)
        crowd.leader, place = np.tile(np.arange(PEOPLE), (SCENES, 1)), np.zeros(shape, int)
        for person in range(1, PEOPLE):
            is_member = joins[:, person] & (place[:, person - 1] < most[:, person])
            crowd.leader[:, person] = np.where(is_member, crowd.leader[:, person - 1], person)
            place[:, person] = np.where(is_member, place[:, person - 1] + 1, 0)
        # Abreast, left and right of the leader by turns, a little before or behind.
        aside = np.where(place % 2 == 1, 1, -1) * ((place + 1) // 2)
        back = rng.uniform(-0.2, 0.5, shape) * np.abs(aside)
        crowd.offset = np.stack([aside * rng.uniform(0.5, 1.1, shape), -back], -1)
        start = rng.uniform(0, 1, (*shape, 2)) * crowd.side_m[..., None]
        crowd.place = start[scene, crowd.leader] + crowd.offset
        crowd.pace, crowd.stands = crowd.pace[scene, crowd.leader], crowd.stands[scene, crowd.leader]
        crowd.rest_s = np.where(crowd.stands, rng.exponential(60, shape), 0.0)[scene, crowd.leader]
        crowd.direction = rng.choice([-1, 1], shape)
        crowd.gates = rng.uniform(0, 1, (SCENES, 5, 2)) * crowd.side_m[..., None]
        edge = rng.integers(0, 4, (SCENES, 5))
        for number in range(4):
            axis, end = divmod(number, 2)
            crowd.gates[..., axis] = np.where(edge == number, end * crowd.side_m, crowd.gates[..., axis])
        crowd._new_goal(np.ones(shape, bool), 3.0)
        return crowd

    def _new_goal(self, which: np.ndarray, spread: float) -> None:
        rng, shape = self.rng, which.shape
        heading = np.arctan2(self.speed[..., 1], self.speed[..., 0]) + spread * rng.standard_t(3, shape) / 1.7
        far = np.exp(rng.uniform(np.log(15), np.log(150), shape)) / self.restless * np.maximum(self.pace / 1.3, 1.0)
        goal = self.place + far[..., None] * np.stack([np.cos(heading), np.sin(heading)], -1)
        gate = self.gates[np.arange(SCENES)[:, None], rng.integers(0, 5, shape)] + rng.normal(0, 1.0, (*shape, 2))
        lane = np.clip(self.place[..., 1] + rng.normal(0, 2, shape), 0, self.side_m)
        flow = np.stack([self.place[..., 0] + self.direction * 60, lane], -1)
        goal = np.where((self.kind == 1)[..., None], gate, goal)
        goal = np.where((self.kind == 2)[..., None], flow, goal)
        self.goal = np.where(which[..., None], goal, self.goal)

    def step(self) -> None:
        super().step()
        lead, side = self.place[np.arange(SCENES)[:, None], self.leader], self.side_m[..., None]
        shift = np.where(lead > side + 5, -(side + 10), np.where(lead < -5, side + 10, 0.0))
        shift = np.where((self.kind == 1)[..., None], 0.0, shift)  # gates lie inside
        self.place, self.goal = self.place + shift, self.goal + shift
        self.jumped = (shift != 0).any(-1)


def frames(seed: int) -> tuple[np.ndarray, ...]:
    """Pasts (N, M, 8, 2) as tracked, which are known, true futures (N, M, 12, 2), and which of these are complete."""
    rng = np.random.default_rng(seed)
    crowd = Crowd.begin(rng)
    for _ in range(80):
        crowd.step()
    path, jumps = [], []
    jumped = np.zeros(crowd.pace.shape, bool)
    for fine in range(2 * LENGTH):
        crowd.step()
        jumped |= crowd.jumped
        if fine % 2 == 0:
            path.append(crowd.place.copy())
            jumps.append(jumped)
            jumped = np.zeros_like(jumped)
    true, segment = np.stack(path, 2), np.cumsum(np.stack(jumps, 2), axis=2)
    sigma = 0.4 * rng.random((SCENES, 1, 1)) ** 2 * (rng.random((SCENES, 1, 1)) < 0.95)
    sigma = sigma * np.exp(rng.normal(0, 0.2, (SCENES, PEOPLE, 1)))
    seen_m = true + sigma[..., None] * ar1(rng, SCENES * PEOPLE, LENGTH).reshape(true.shape)
    shape = (SCENES, PEOPLE)
    begin = np.where(rng.random(shape) < 0.6, -100, rng.integers(-10, LENGTH, shape))[..., None]
    end = np.where(rng.random(shape) < 0.6, LENGTH, begin[..., 0] + rng.integers(8, 80, shape))[..., None]
    has_gap = rng.random((SCENES, PEOPLE, LENGTH)) < 0.3 * (rng.random((SCENES, 1, 1)) < 0.4)
    seen = (np.arange(LENGTH) >= begin) & (np.arange(LENGTH) < end) & ~has_gap
    parts = []
    for now in range(PAST + int(rng.integers(0, STRIDE)), LENGTH - STEPS, STRIDE):
        back = slice(now - PAST + 1, now + 1)
        known = seen[:, :, back] & (segment[:, :, back] == segment[:, :, now, None]) & seen[:, :, now, None]
        ahead = segment[:, :, now + STEPS] == segment[:, :, now]
        parts.append((seen_m[:, :, back], known, true[:, :, now + 1 : now + 1 + STEPS], known[..., -1] & ahead))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def examples(seed: int) -> dict[str, np.ndarray]:
    """What the network is given for each track (B,), and the true future; positions are relative to the current one."""
    past, known, future, is_complete = frames(seed)
    there = known[..., -1]
    moment = np.nonzero(there)[0]
    row = np.flatnonzero(is_complete[there])
    people = PeopleSeen(past[there], known[there], moment, row)
    network = blank()
    everyone = network.see(people.xy_m, people.valid)
    track, other = social.pairs_of(people, everyone.xy_m[:, -1])
    tracks = taken(everyone, row)
    slot = np.arange(len(track)) - np.searchsorted(track, track)
    count = len(row)
    pairs, differ = np.zeros((count, K, social.PAIR_FEATURES)), np.zeros((count, K, STEPS, 2))
    is_there = np.zeros((count, K), bool)
    one, two = taken(tracks, track), taken(everyone, other)
    pairs[track, slot], is_there[track, slot] = social.pair_features(one, two, STEP_S), True
    differ[track, slot] = (two.mean - two.xy_m[:, -1:]) - (one.mean - one.xy_m[:, -1:])
    now = tracks.xy_m[:, -1:]
    turn = tracks.turn[:, None]
    own = np.concatenate([social.own_features(tracks), tracks.state], axis=1)
    out = {"own": own, "pairs": pairs, "there": is_there, "differ": differ, "mean": tracks.mean - now}
    out |= {"cov": turn @ tracks.cov @ turn.transpose(0, 1, 3, 2), "turn": tracks.turn, "gate": tracks.gate}
    out |= {"spread": tracks.spread, "future": future[there][row] - now}
    small = ("own", "pairs", "differ")
    return {k: v if v.dtype == bool else v.astype(np.float16 if k in small else np.float32) for k, v in out.items()}


def blank() -> social.Social:
    """A network that only has the weights of `red`."""
    tensors = {f"red.{name}": part for name, part in RED.tensors.items()}
    return social.Social(
        Weights(SHIPPED, tensors, {"network": "social", "steps": str(STEPS), "step_s": str(STEP_S)}, "")
    )


class SocialNetwork(nn.Module):
    """See `mcaptrack.predictors.social`; `uses`: "nothing" of others, what is "pooled", or also their displacements."""

    def __init__(self, uses: str) -> None:
        super().__init__()
        state = RED.tensors["gru.weight_hh"].shape[-1]
        self.uses = uses
        self.own = nn.Linear(social.OWN_FEATURES + state, HIDDEN)
        self.pair, self.both = nn.Linear(social.PAIR_FEATURES, HIDDEN), nn.Linear(HIDDEN, HIDDEN)
        self.of_own = nn.Linear(HIDDEN, HIDDEN, bias=False)
        self.attention, self.alone = nn.Linear(HIDDEN, 3), nn.Linear(HIDDEN, 3)
        self.dense, self.head = nn.Linear(3 * HIDDEN, DENSE), nn.Linear(DENSE, STEPS * social.OUTPUTS)
        for layer in (self.head, self.alone):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        with torch.no_grad():
            self.alone.bias.copy_(torch.tensor([0.0, 3.0, 3.0]))
        self.register_buffer("late", torch.linspace(0, 1, STEPS))

    def forward(self, given: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Means relative to the current position, and covariances along and across the direction."""
        there = given["there"][..., None]
        own = torch.tanh(self.own(given["own"]))
        seen = torch.tanh(self.both(torch.tanh(self.pair(given["pairs"]))) + self.of_own(own)[:, None])
        score = self.attention(seen).masked_fill(~there, -1e4)
        share = torch.cat([score, self.alone(own)[:, None]], 1).softmax(1)[:, :-1]
        is_used = there & (self.uses != "nothing")
        pool = (share[..., :1] * seen * is_used).sum(1)
        total = (torch.sigmoid(score[..., :1]) * seen * is_used).sum(1)
        mean = given["mean"]
        if self.uses == "displacements":
            taken = (1 - self.late) * share[..., 1:2] + self.late * share[..., 2:3]
            mean = mean + (taken[..., None] * given["differ"]).sum(1)
        out = self.head(torch.tanh(self.dense(torch.cat([own, pool, total], 1)))).reshape(-1, STEPS, social.OUTPUTS)
        gate = given["gate"][:, None]
        mean = mean + (out[..., :2] * (gate * given["spread"])[..., None]) @ given["turn"]
        along, across = torch.exp(out[..., 2] + gate * out[..., 3]), torch.exp(out[..., 2] - gate * out[..., 3])
        cov = given["cov"]
        return mean, cov[..., 0, 0] * along**2, cov[..., 1, 1] * across**2, cov[..., 0, 1] * along * across

    def loss(self, given: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """The negative log-likelihood and ten times the mean distance, as in the recipe `red`; and the distances."""
        mean, xx, yy, xy = self(given)
        off = (given["future"] - mean) @ given["turn"].transpose(1, 2)
        free = (xx * yy - xy**2).clamp_min(1e-12)
        x, y = off[..., 0], off[..., 1]
        nll = (yy * x * x + xx * y * y - 2 * xy * x * y) / (2 * free) + free.log() / 2
        distance = torch.sqrt((off**2).sum(-1) + 1e-6)
        return nll.mean() + 10 * distance.mean(), distance.detach().mean(0)

    def tensors(self) -> dict[str, np.ndarray]:
        """The weights by the names that `mcaptrack.predictors.social` reads, with those of `red`."""
        own = {name: part.detach().cpu().double().numpy() for name, part in self.state_dict().items()}
        del own["late"]
        own["both.own"] = own.pop("of_own.weight")
        return own | {f"red.{name}": part for name, part in RED.tensors.items()}


def batch_of(data: dict[str, torch.Tensor], at: torch.Tensor) -> dict[str, torch.Tensor]:
    return {name: part[at].float() if part.is_floating_point() else part[at] for name, part in data.items()}


def train(data: dict, held: dict, seed: int, uses: str, epochs: int) -> tuple[SocialNetwork, np.ndarray]:
    """Train one network; also returns its errors (T,) on the crowds that are held back."""
    torch.manual_seed(seed)
    network = SocialNetwork(uses).to(DEVICE)
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-4)
    count, size, began = len(data["there"]), 2048, time.time()
    total, done = epochs * (count // size), 0
    for epoch in range(epochs):
        order = torch.randperm(count, device=DEVICE)
        for at in order[: count // size * size].split(size):
            share = done / total
            rate = 2e-3 * (share / 0.1 if share < 0.1 else (1 + np.cos(np.pi * (share - 0.1) / 0.9)) / 2)
            for group in optimiser.param_groups:
                group["lr"] = max(rate, 1e-6)
            loss, _ = network.loss(batch_of(data, at))
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            done += 1
        with torch.no_grad():
            parts = torch.arange(len(held["there"]), device=DEVICE).split(size)
            errors = sum(len(at) * network.loss(batch_of(held, at))[1] for at in parts) / len(held["there"])
        scores = f"ADE {errors.mean():.4f}, FDE {errors[-1]:.4f}"
        print(f"{uses} {seed}: epoch {epoch + 1}, {scores}, {time.time() - began:.0f} s", flush=True)
    return network, errors.cpu().numpy()


def publish(network: SocialNetwork, held: dict, path: Path, card: dict[str, str]) -> None:
    """Scale the covariance of every step so that its 95 % ellipse holds 95 % of the crowds held back, and write."""
    squared = []
    with torch.no_grad():
        for at in torch.arange(len(held["there"]), device=DEVICE).split(8192):
            given = batch_of(held, at)
            mean, xx, yy, xy = (part.cpu().numpy().astype(float) for part in network(given))
            off = (given["future"].cpu().numpy() - mean) @ given["turn"].cpu().numpy().transpose(0, 2, 1)
            squared.append(mahalanobis_squared(off, np.stack([xx, xy, xy, yy], -1).reshape(*xx.shape, 2, 2)))
    ratio = np.quantile(np.concatenate(squared), 0.95, axis=0) / (-2 * np.log(0.05))
    tensors = network.tensors()
    tensors["head.bias"][2 :: social.OUTPUTS] += np.log(ratio) / 2
    save(path, tensors, card)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--batches", type=int, default=64, help=f"so many times {SCENES} scenes")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--ablation", action="store_true")
    given = parser.parse_args()
    with Pool(os.cpu_count()) as pool:
        seeds = range(100, 100 + given.batches + max(2, given.batches // 16))
        parts = pool.map(examples, seeds, chunksize=1)
    data, held = (
        {name: torch.tensor(np.concatenate([part[name] for part in some]), device=DEVICE) for name in parts[0]}
        for some in (parts[: given.batches], parts[given.batches :])
    )
    away = (held["mean"] - held["future"]).norm(dim=-1)
    print(f"{len(data['there'])} tracks, red: ADE {away.mean():.4f}, FDE {away[:, -1].mean():.4f}", flush=True)
    for seed in given.seeds:
        for uses in ("nothing", "pooled", "displacements") if given.ablation else ("displacements",):
            network, errors = train(data, held, seed, uses, given.epochs)
            name = f"social_{seed}" + ("" if uses == "displacements" else f"_{uses}")
            card = {
                "network": "social", "past": str(PAST), "steps": str(STEPS), "step_s": str(STEP_S),
                "data": f"{len(data['there'])} synthetic walks of mcaptrack {__version__} in crowds",
                "trained_by": f"tools/train_social.py --batches {given.batches} --epochs {given.epochs}, seed {seed}",
                "scores_noisy": f"ADE_m={errors.mean():.3f} FDE_m={errors[-1]:.3f}",
                "scores_noisy_red": f"ADE_m={away.mean():.3f} FDE_m={away[:, -1].mean():.3f}",
                "red_sha256": RED.sha256, "licence": "Apache-2.0", "made_by": f"mcaptrack {__version__}",
            }  # fmt: skip
            publish(network, held, given.output / f"{name}.safetensors", card)


if __name__ == "__main__":
    main()
