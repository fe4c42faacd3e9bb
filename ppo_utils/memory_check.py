"""Checks of an agent's memory, whoever made it: what goes wrong in recurrent agents without an error.

An agent is wrapped into an `Adapter`, `check(adapter)` returns a `Report`. It observes random numbers, since no check
needs an environment. Shape letters: T steps, N lanes (parallel environments), P outputs of the policy.

Outputs are compared, never actions: logits, or means and deviations, whatever the distribution has, and values.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

STEPS, LANES = 24, 4
# (step, lane) where an episode begins; one has a single step
STARTS = ((0, 0), (0, 1), (0, 2), (0, 3), (7, 1), (8, 2), (9, 2), (15, 1), (23, 3))


class Adapter:
    """What the check asks of an agent. `obs_shape` and the first three methods are needed, the others can be.

    Observations come as float32 tensors (..., *obs_shape) of normally distributed numbers; `observations` makes others.
    Whatever a state is, the check hands it on, and copies of it. All is on the CPU. Rollouts have 1 to 48 steps of 2 to
    96 lanes, episodes up to 48 steps. The agent must be in evaluation mode, and its weights must not change.
    """

    obs_shape: tuple[int, ...]
    reach: int | None = None  # how many steps back the policy's gradient is meant to reach; None: not checked

    def initial(self, lanes: int) -> Any:
        """Return the state of so many lanes whose episodes begin."""
        raise NotImplementedError

    def act(self, obs: Tensor, state: Any, begins: Tensor) -> tuple[Tensor, Tensor, Any]:
        """Take a step as in a rollout, obs (N, ...): the policy's outputs (N, P), values (N,), and the next state.

        begins: (N,) bool, which lanes' observations are the first of an episode, whose state has to be forgotten.
        """
        raise NotImplementedError

    def evaluate(self, obs: Tensor, begins: Tensor, stored: Any) -> tuple[Tensor, Tensor]:
        """Compute a whole rollout as the update does, obs (T, N, ...), begins (T, N): outputs (T, N, P), values (T, N).

        stored: what `rollout` returned last, by default the list of the states before each step. If the result has a
        gradient with respect to obs, it is checked, too.
        """
        raise NotImplementedError

    def rollout(self, obs: Tensor, begins: Tensor, state: Any) -> tuple[Tensor, Tensor, Any, Any]:
        """Act for T steps: outputs (T, N, P), values (T, N), the state after them, and what `evaluate` needs."""
        outputs, values, stored = [], [], []
        for now, begin in zip(obs, begins, strict=True):
            stored.append(copy.deepcopy(state))
            output, value, state = self.act(now, state, begin)
            outputs.append(output)
            values.append(value)
        return torch.stack(outputs), torch.stack(values), state, stored

    def value(self, obs: Tensor, state: Any) -> Tensor | None:
        """Return the values (N,) of the final observations of episodes that a time limit ends; None: not used."""
        return None

    def reloaded(self) -> Adapter | None:
        """Return an adapter of this agent after it was saved and loaded; None: not checked."""
        return None

    def observations(self, steps: int, lanes: int) -> Tensor:
        """Return random observations (T, N, *obs_shape)."""
        return torch.randn(steps, lanes, *self.obs_shape)


@dataclass
class Finding:
    """One check: what was found, and what that does to a training."""

    check: str
    passed: bool
    says: str = ""


@dataclass
class Report:
    """All findings, and how much an action depends on the observation of k steps ago, by k."""

    findings: list[Finding] = field(default_factory=list)
    dependence: dict[int, float] = field(default_factory=dict)
    gradient_reach: int | None = None  # steps back to the farthest observation with a gradient; None: not known

    @property
    def failed(self) -> list[Finding]:
        """The findings that tell of a fault."""
        return [finding for finding in self.findings if not finding.passed]

    def __str__(self) -> str:
        lines = [f"{'ok   ' if each.passed else 'FAULT'} {each.check}: {each.says}" for each in self.findings]
        if self.gradient_reach is not None:
            lines.append(
                f"      the update's gradient reaches {self.gradient_reach} steps back, of at most {STEPS - 1}"
            )
        curve = ", ".join(f"{k}: {change:.2g}" for k, change in self.dependence.items())
        return "\n".join(
            [*lines, f"      change of the outputs if the observation of k steps ago changes, by k: {curve}"]
        )


def check(adapter: Adapter, tolerance: float = 1e-4, seed: int = 0) -> Report:
    """Run all checks. tolerance: the largest difference that counts as rounding, in the outputs' deviations."""
    torch.manual_seed(seed)
    case = Case(adapter, tolerance)
    report = Report()
    for make in CHECKS:
        found = make(case)
        if found is not None:
            report.findings.append(found)
        if make is repeats and not found.passed:
            break  # no difference that other checks would see tells anything
    report.dependence, report.gradient_reach = case.dependence, case.reach
    return report


class Case:
    """An agent and a rollout of it: observations, where episodes begin, and what it computed."""

    def __init__(self, adapter: Adapter, tolerance: float):
        self.adapter = adapter
        self.obs = adapter.observations(STEPS, LANES)
        self.begins = torch.zeros(STEPS, LANES, dtype=torch.bool)
        for step, lane in STARTS:
            self.begins[step, lane] = True
        self.acted, self.next_state, self.stored = self.act()
        finite = self.acted.nan_to_num(0.0, 0.0, 0.0).flatten(0, 1)  # an action that is masked may be -inf
        self.scale = finite.std(0) + 0.01 * finite.abs().amax(0) + 1e-12  # (P + 1,), of each output
        self.tolerance = tolerance
        self.dependence = dependence(self)
        self.reach: int | None = None

    def act(
        self, obs: Tensor | None = None, begins: Tensor | None = None, state: Any = None
    ) -> tuple[Tensor, Any, Any]:
        """Outputs and values (T, N, P + 1) of a rollout, from a fresh state unless there is one, and what follows."""
        obs, begins = self.obs if obs is None else obs, self.begins if begins is None else begins
        with torch.no_grad():
            state = self.adapter.initial(obs.shape[1]) if state is None else state
            outputs, values, state, stored = self.adapter.rollout(obs.clone(), begins.clone(), copy.deepcopy(state))
        return joined(outputs, values), state, stored

    def evaluate(self, obs: Tensor | None = None, begins: Tensor | None = None, stored: Any = None) -> Tensor:
        """Outputs and values (T, N, P + 1) that the update computes; with other observations, after acting on these."""
        if stored is None:
            stored = self.stored if obs is None and begins is None else self.act(obs, begins)[2]
        obs, begins = self.obs if obs is None else obs, self.begins if begins is None else begins
        return joined(*self.adapter.evaluate(obs.clone(), begins.clone(), copy.deepcopy(stored)))

    def differs(self, one: Tensor, other: Tensor) -> Tensor:
        """(...,) bool: where outputs (..., P + 1) are not the same, NaN included."""
        return ~(((one - other).abs() <= self.tolerance * self.scale) | (one == other)).all(-1)

    def change(self, one: Tensor, other: Tensor) -> Tensor:
        """(P + 1,) how much each output changes from one step (N, P + 1) to the other, in its deviations."""
        return ((one - other) / self.scale).nan_to_num(0.0).abs().mean(0)

    def ways(self) -> list[tuple[str, Callable[..., Tensor]]]:
        """The two ways in which outputs are computed, each from observations and episode starts."""
        return [
            ("acting", lambda obs, begins: self.act(obs, begins)[0]),
            ("the update", lambda obs, begins: self.evaluate(obs, begins).detach()),
        ]


def joined(outputs: Tensor, values: Tensor) -> Tensor:
    """Outputs (..., P) and values (...) as one tensor (..., P + 1). Raises ValueError for other shapes."""
    if outputs.shape[:-1] != values.shape:
        raise ValueError(
            f"outputs {tuple(outputs.shape)} need values {tuple(outputs.shape[:-1])}, not {tuple(values.shape)}"
        )
    return torch.cat([outputs.float(), values.float()[..., None]], -1)


def first(where: Tensor) -> str:
    """The first place of a mask (T, N), in words, and how many more there are."""
    step, lane = where.nonzero()[0].tolist()
    more = int(where.sum()) - 1
    return f"step {step}, lane {lane}" + (f" and {more} more" if more else "")


# ---- checks ----


def recomputes(case: Case) -> Finding:
    """The update recomputes what acted: before it has learned, every probability ratio is one."""
    wrong = case.differs(case.evaluate().detach(), case.acted)
    says = "the update computes what acting computed"
    if wrong.any():
        inside = wrong & (episode_steps(case.begins) > 0)
        later = "from the episodes' second steps on"
        if (wrong & ~inside).any():
            later = "also in episodes' first steps: dropout or statistics of a batch, maybe"
        if not inside.any():
            later = "only in episodes' first steps: does it hide what an empty memory holds?"
        says = f"the update computes something else ({first(wrong)}; {later}): its ratios are not one before it learns"
        says += ", so PPO clips and learns from a policy that never acted"
    return Finding("ratio one", not wrong.any(), says)


def resets(case: Case) -> Finding:
    """An episode's first step is that of a fresh agent, at that very step, in acting and in the update."""
    fresh, _, _ = case.act(case.obs.flatten(0, 1)[None], torch.ones(1, STEPS * LANES, dtype=torch.bool))
    fresh = fresh[0].unflatten(0, (STEPS, LANES))
    for way, run in case.ways():
        outputs = run(None, None)
        wrong = case.differs(outputs, fresh) & case.begins
        if wrong.any():
            says = f"in {way}, an episode's first step is not that of a fresh agent ({first(wrong)}): "
            says += "the memory is reset too late or not at all, or what an empty one holds is not hidden"
            return Finding("reset", False, says)
    return Finding("reset", True, "an episode begins as a fresh agent does, in acting and in the update")


def keeps_episodes_apart(case: Case) -> Finding:
    """What was observed before an episode changes nothing in it."""
    for way, run in case.ways():
        before, now = run(None, None), run(other_past(case), None)
        wrong = case.differs(before, now) & last_episode(case.begins)
        if wrong.any():
            says = f"in {way}, an episode depends on what was observed before it began ({first(wrong)})"
            return Finding("ends of episodes", False, f"{says}: values and actions are of a past that is over")
    return Finding("ends of episodes", True, "nothing that was observed before an episode changes it")


def gradients_stay(case: Case) -> Finding | None:
    """No gradient crosses the end of an episode or goes to another lane; and how far back one reaches."""
    obs = case.obs.clone().requires_grad_() if case.obs.is_floating_point() else case.obs
    outputs, wanted = case.evaluate(obs, stored=case.stored), case.adapter.reach
    if not obs.requires_grad:
        return None
    if not outputs.requires_grad or gradient(outputs.sum(), obs) is None:
        return None if wanted is None else Finding("gradient", False, "the update has no gradient to any observation")
    weights = torch.randn(outputs.shape[-1])
    for lane in range(LANES):
        others = gradient((outputs[:, lane] * weights).sum(), obs)
        others[:, lane] = False
        if others.any():
            says = (
                f"the gradient of lane {lane} reaches the observation of {first(others)}: lanes learn from each other"
            )
            return Finding("gradient", False, says)
    steps, reaches = episode_steps(case.begins), torch.zeros(LANES, dtype=torch.int64)
    time = torch.arange(STEPS)[:, None]
    for step in range(STEPS):
        wrong = gradient((outputs[step] * weights).sum(), obs)
        wrong &= ~((time >= step - steps[step]) & (time <= step))
        if wrong.any():
            says = f"the gradient of step {step} reaches the observation of {first(wrong)}, of another episode or later"
            return Finding("gradient", False, says)
        earlier = gradient((outputs[step] * weights)[:, :-1].sum(), obs) * (step - time)  # (T, N) how much earlier
        reaches = torch.maximum(reaches, earlier.amax(0))
    case.reach = int(reaches.max())
    for lane, (reach, longest) in enumerate(zip(reaches.tolist(), steps.amax(0).tolist(), strict=True)):
        if wanted is not None and reach != min(wanted, longest):
            says = f"the policy's gradient reaches {reach} steps back in lane {lane}, not {min(wanted, longest)}"
            effect = (
                "what is further away is hardly learned" if reach < wanted else "it is not cut where it is meant to be"
            )
            return Finding("gradient", False, f"{says}: {effect}")
    return Finding("gradient", True, "none crosses the end of an episode or reaches another lane")


def gradient(output: Tensor, obs: Tensor) -> Tensor | None:
    """(T, N) bool: which observations (T, N, ...) the output has a gradient to; None: it depends on none."""
    (found,) = torch.autograd.grad(output, obs, retain_graph=True, allow_unused=True)
    return None if found is None else found.flatten(2).abs().sum(-1) != 0


def keeps_lanes_apart(case: Case) -> Finding:
    """A lane's outputs depend on its own observations and episodes alone, and not on where it stands."""
    order = torch.tensor([*range(1, LANES), 0])
    wild = case.adapter.observations(STEPS, LANES)
    wild[:, 0] = case.obs[:, 0]
    ends = case.begins.clone()
    ends[3::4, 1:] = True  # another number of episodes, and other lengths, in all lanes but the first
    for way, run in case.ways():
        before = run(None, None)
        for what, other in (("observations", (wild, None)), ("episodes", (None, ends))):
            wrong = case.differs(before[:, :1], run(*other)[:, :1])
            if wrong.any():
                says = f"in {way}, a lane depends on other lanes' {what} ({first(wrong)}): "
                return Finding("lanes", False, says + "a reset, a mask, padding or statistics hit the wrong lanes")
        permuted = run(case.obs[:, order], case.begins[:, order])
        wrong = case.differs(before[:, order], permuted)
        if wrong.any():
            says = f"in {way}, a lane's outputs change with its place among the lanes ({first(wrong)})"
            return Finding("lanes", False, f"{says}: two axes are mixed up")
    return Finding("lanes", True, "a lane depends on itself alone")


def goes_on(case: Case) -> Finding:
    """The next rollout goes on where acting stopped, also after an update."""
    begins = torch.zeros_like(case.begins)
    begins[0, 1] = True
    whole, _, _ = case.act(torch.cat([case.obs, case.obs]), torch.cat([case.begins, begins]))
    case.evaluate()
    parts, _, _ = case.act(case.obs, begins, case.next_state)
    wrong = case.differs(parts, whole[STEPS:])
    says = "the next rollout goes on where this one stopped"
    if wrong.any():
        says = f"the next rollout does not go on where this one stopped ({first(wrong)}): "
        says += "episodes lose their past, or one that begins with it keeps another's"
    return Finding("next rollout", not wrong.any(), says)


def recomputes_later(case: Case) -> Finding:
    """The update also recomputes a rollout that begins in the middle of episodes."""
    begins = torch.zeros_like(case.begins)
    begins[0, 1] = begins[STEPS // 2, 0] = True
    acted, _, stored = case.act(case.obs, begins, case.next_state)
    wrong = case.differs(case.evaluate(case.obs, begins, stored).detach(), acted) & ~begins
    says = "the update recomputes rollouts that begin within an episode"
    if wrong.any():
        says = f"where a rollout begins within an episode, the update computes something else ({first(wrong)}): "
        says += "it does not begin with the memory that acting had"
    return Finding("stored state", not wrong.any(), says)


def repeats(case: Case) -> Finding:
    """Acting elsewhere, as an evaluation does, changes nothing for the training."""
    again, _, _ = case.act()
    wrong = case.differs(again, case.acted)
    if not wrong.any():
        with torch.no_grad():
            state = case.adapter.initial(LANES)
            for step in range(STEPS):
                output, value, state = case.adapter.act(case.obs[step], state, case.begins[step])
                wrong[step] = case.differs(joined(output, value), case.acted[step])
                other, no_start = case.adapter.observations(1, 2)[0], torch.zeros(2, dtype=torch.bool)
                case.adapter.act(other, case.adapter.initial(2), no_start)
    says = "an evaluation begins afresh and leaves the training's memory alone"
    if wrong.any():
        says = f"the same observations give other outputs the second time ({first(wrong)}): "
        says += (
            "the agent has a memory or running statistics of its own, or is in training mode; nothing else is checked"
        )
    return Finding("evaluation", not wrong.any(), says)


def values_final_observations(case: Case) -> Finding | None:
    """The value of an ended episode's final observation is that of the step it would have been."""
    none = torch.zeros(1, LANES, dtype=torch.bool)
    final, state = case.adapter.observations(1, LANES), copy.deepcopy(case.next_state)
    with torch.no_grad():
        value = case.adapter.value(final[0].clone(), state)
    if value is None:
        return None
    wanted, _, _ = case.act(final, none, case.next_state)
    wrong = case.differs(joined(wanted[0, :, :-1], value), wanted[0])
    says = "a time limit's value is that of the episode that ended"
    if case.differs(case.act(final, none, state)[0], wanted).any():
        says = "computing the value of an observation moves the memory on: later steps have seen it twice"
        return Finding("time limit", False, says)
    if wrong.any():
        says = f"the value of a final observation is not that of its episode (lane {int(wrong.nonzero()[0])}): "
        says += "it is computed with a memory that was reset already, or with that of another step"
    return Finding("time limit", not wrong.any(), says)


def survives_saving(case: Case) -> Finding | None:
    """A saved and loaded agent acts the same."""
    other = case.adapter.reloaded()
    if other is None:
        return None
    with torch.no_grad():
        outputs, values, _, _ = other.rollout(case.obs.clone(), case.begins.clone(), other.initial(LANES))
    wrong = case.differs(joined(outputs, values), case.acted)
    says = "a saved and loaded agent acts the same"
    if wrong.any():
        says = f"a saved and loaded agent acts differently ({first(wrong)}): something that it needs is not saved"
    return Finding("saving", not wrong.any(), says)


def remembers(case: Case) -> Finding:
    """The memory is used at all: earlier observations change what the agent does now."""
    begins = torch.zeros_like(case.begins)
    begins[0] = True
    other = case.adapter.observations(STEPS, LANES)
    other[-1] = case.obs[-1]
    before, after = (case.act(obs, begins)[0][-1] for obs in (case.obs, other))
    policy, value = case.change(before, after)[:-1].amax().item(), case.change(before, after)[-1].item()
    says = (
        f"other earlier observations change the policy by {policy:.2g} and the value by {value:.2g} of their deviation"
    )
    if policy <= case.tolerance:
        says = "no earlier observation changes the policy: this agent has no memory"
    return Finding("memory", policy > case.tolerance, says)


CHECKS = (
    repeats,
    remembers,
    recomputes,
    recomputes_later,
    resets,
    keeps_episodes_apart,
    gradients_stay,
    keeps_lanes_apart,
    goes_on,
    values_final_observations,
    survives_saving,
)


# ---- parts ----


def dependence(case: Case) -> dict[int, float]:
    """How much the last step's outputs change with the observation k steps before, at most, in their deviations."""
    begins = torch.zeros_like(case.begins)
    begins[0] = True
    before, _, _ = case.act(case.obs, begins)
    curve = {}
    for k in sorted({0, 1, 2, 4, 8, 16, STEPS - 1}):
        obs = case.obs.clone()
        obs[STEPS - 1 - k] = case.adapter.observations(1, LANES)[0]
        after, _, _ = case.act(obs, begins)
        curve[k] = case.change(before[-1], after[-1]).amax().item()
    return curve


def episode_steps(begins: Tensor) -> Tensor:
    """(T, N) how many steps each step is into its episode, or into the rollout."""
    steps = torch.arange(len(begins))[:, None].expand_as(begins)
    return steps - torch.where(begins, steps, 0).cummax(0).values


def last_episode(begins: Tensor) -> Tensor:
    """(T, N) bool: the steps of each lane's last episode."""
    return begins.cumsum(0) == begins.sum(0)


def other_past(case: Case) -> Tensor:
    """The observations (T, N, ...) with others before each lane's last episode."""
    past = ~last_episode(case.begins)
    obs = case.obs.clone()
    obs[past] = case.adapter.observations(STEPS, LANES)[past]
    return obs
