"""Runs methods on the same scenes, batch by batch, and has them judged."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter

from drake_oa.studies.scenes.judge import Judgement, joined, judge
from drake_oa.studies.scenes.methods import Method, Motions
from drake_oa.studies.scenes.scenes import Scenes
from drake_oa.studies.scenes.suites import Case

BATCH = 1000
"""Scenes a batch at most: some hundred megabytes of paths."""

_FIRST, _LEAST, _PATIENCE = 32, 16, 1.0
"""Scenes in the first batch, in any later one at least, and how long one may take [s]."""


@dataclass
class Outcome:
    """What one method has come to so far.

    Attributes:
        judged: label of each case -> the batches judged, in the order of the scenes.
        seconds: computing time [s].
        steps: policy steps computed.
        complete: whether all scenes were run in all cases.
        error: why not, where the method failed.
    """

    judged: dict[str, list[Judgement]] = field(default_factory=dict)
    seconds: float = 0.0
    steps: int = 0
    complete: bool = False
    error: str | None = None

    def of(self, *labels: str) -> Judgement:
        """The judgement of some cases, of all without any label."""
        return joined(
            [part for label in labels or self.judged for part in self.judged.get(label, [])]
        )


@dataclass(frozen=True)
class Evaluation:
    """Outcomes by the method's name, and whether it was interrupted before the end."""

    outcomes: dict[str, Outcome]
    interrupted: bool = False


def evaluate(
    scenes: Scenes,
    cases: Sequence[Case],
    methods: Mapping[str, Method],
    *,
    batch: int = BATCH,
    on_progress: Callable[[str, int], None] = lambda name, count: None,
    on_method: Callable[[Mapping[str, Outcome]], None] = lambda outcomes: None,
    on_motions: Callable[[str, Motions], None] = lambda name, motions: None,
    judged_among: Callable[[Scenes], Scenes] = lambda scenes: scenes,
) -> Evaluation:
    """Runs each method on all scenes in each case.

    What was judged is kept when a method fails, and when it is interrupted (Ctrl-C). Batches
    are as large as takes about a second, so a method must treat each scene by itself.

    Args:
        scenes: the scenes.
        cases: the ways in which each is run.
        methods: name -> what loads the method.
        batch: scenes handed to a method at once, at most.
        on_progress: told the method's name and how many scenes were judged since.
        on_method: told all outcomes after each method.
        on_motions: told the method's name and each batch of motions.
        judged_among: of the scenes of a batch, those that its motions are judged among.

    Returns:
        The outcomes of the methods that were begun.
    """
    outcomes: dict[str, Outcome] = {}
    for name, method in methods.items():
        outcome = outcomes[name] = Outcome()
        try:
            for part, motions in _judged_batches(
                outcome, scenes, cases, method, batch, judged_among
            ):
                on_motions(name, motions)
                on_progress(name, len(part))
            outcome.complete = True
        except KeyboardInterrupt:
            on_method(outcomes)
            return Evaluation(outcomes, interrupted=True)
        except Exception as error:
            # One method's failure, whatever it is, must not cost the others' results.
            outcome.error = f"{type(error).__name__}: {error}"
            logging.getLogger(__name__).info("where %s failed", name, exc_info=True)
        on_method(outcomes)
    return Evaluation(outcomes)


def _judged_batches(
    outcome: Outcome,
    scenes: Scenes,
    cases: Sequence[Case],
    method: Method,
    batch: int,
    judged_among: Callable[[Scenes], Scenes],
) -> Iterator[tuple[Judgement, Motions]]:
    """Runs and judges batch by batch, and notes each in the outcome."""
    size = min(_FIRST, batch)
    for case in cases:
        asked = case.of(scenes)
        parts = outcome.judged.setdefault(case.label, [])
        done = 0
        while done < len(scenes):
            begin = perf_counter()
            some = asked.rows(slice(done, done + size))
            motions = method(some, case.setting)
            judged = judge(judged_among(some), motions)
            parts.append(judged)
            outcome.seconds += motions.seconds
            outcome.steps += motions.steps * len(some)
            done += len(some)
            yield judged, motions
            fitting = _PATIENCE * len(some) / max(perf_counter() - begin, 1e-9)
            size = min(max(int(min(fitting, 4.0 * size)), _LEAST), batch)
