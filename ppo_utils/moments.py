"""Running moments of what all processes see, and the scale of rewards that is made of them.

Shape letters: T steps of a rollout, N environments.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ppo_utils.processes import all_gather

LARGEST_REWARD = 10.0  # as Stable-Baselines3's VecNormalize and CleanRL clip it


@dataclass
class Moments:
    """Count, mean and variance of the numbers that were added in all processes."""

    count: int = 0
    mean: float = 0.0
    variance: float = 0.0

    @property
    def deviation(self) -> float:
        """The standard deviation."""
        return math.sqrt(self.variance)

    def add(self, x: Tensor) -> None:
        """Add numbers of any shape, here and those of the other processes; merged as in Chan et al. (1979)."""
        ours = x.numel(), x.double().mean().item(), x.double().var(correction=0).item()
        for count, mean, variance in all_gather(ours):
            self.count += count
            share, delta = count / self.count, mean - self.mean
            self.variance += share * (variance - self.variance + (1 - share) * delta**2)
            self.mean += share * delta


@dataclass
class ReturnScale(Moments):
    """Divides rewards by the deviation, over all steps, of the discounted sum of an episode's rewards.

    No mean is subtracted, so that rewards keep their sign (Engstrom et al., 2020). While rewards are rare, that
    deviation is tiny: scaled rewards are clipped to +-LARGEST_REWARD.
    """

    discounted: Tensor | None = None  # (N,) that sum in the present episodes

    def scale(self, rewards: Tensor, done: Tensor, gamma: float) -> Tensor:
        """Take in a rollout's rewards (T, N); return them scaled and clipped, only clipped while returns are equal."""
        returns = torch.zeros_like(rewards)
        discounted = torch.zeros_like(rewards[0]) if self.discounted is None else self.discounted.to(rewards.device)
        for t in range(len(rewards)):
            returns[t] = discounted * gamma + rewards[t]
            discounted = returns[t] * ~done[t]
        self.discounted = discounted
        self.add(returns)
        return (rewards / (self.deviation or 1.0)).clamp(-LARGEST_REWARD, LARGEST_REWARD)
