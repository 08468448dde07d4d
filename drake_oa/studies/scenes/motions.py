"""What a method did in many scenes: sampled paths, their durations, the computing time."""

from __future__ import annotations

from dataclasses import dataclass

from drake_oa.common.messages import BoolArray, FloatArray, Frozen


@dataclass(frozen=True, eq=False)
class Motions(Frozen):
    """N motions at S + 1 equally spaced instants from t = 0 to their duration.

    Attributes:
        path: (N, S + 1, 3) positions [m].
        velocity: (N, S + 1, 3) velocities dp/dt at those instants [m/s].
        duration: (N,) tau T, the end of the scaled duration [s].
        seconds: computing time of the whole batch [s], regulation included,
            compilation excluded.
        in_range: (N,) whether the regressor chain was asked within its trained range; None:
            there is none, or it does not tell.
        policy_steps: steps of the policy in each motion; None: S of them.
    """

    path: FloatArray
    velocity: FloatArray
    duration: FloatArray
    seconds: float
    policy_steps: int | None = None
    in_range: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.path)

    @property
    def steps(self) -> int:
        """Steps of the policy in each motion."""
        return len(self.path[0]) - 1 if self.policy_steps is None else self.policy_steps
