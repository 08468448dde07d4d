"""Table I of the paper (tab:nn_training): prediction errors of the chains that are shipped.

What training measured stands in the weights' metadata; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from drake_oa.common.console import Column, TextTable
from drake_oa.regulation.regressor import TARGETS
from drake_oa.studies.scenes.paper_method import SHIPPED, paper_chain
from drake_oa.training.paper_set import PRINTED

_COLUMNS = (
    Column("train", form="{:.3g}"),
    Column("train_printed", "print", "{:.3g}"),
    Column("test", form="{:.3g}"),
    Column("test_printed", "print", "{:.3g}"),
    Column("floor", form="{:.3g}"),
    Column("rows", form="{:,d}"),
)


_TOLD = ("chain", "action_level", "rollouts", "seed", "version", "date", "source_digest")
"""Keys of the weights' metadata that the JSON repeats."""


def table_one_figures(versions: Sequence[str]) -> dict[str, Any]:
    """What the JSON holds: of each shipped file its chain, and a row a network.

    NMSE on the train and the test rows; of the chains on the released code's action level the
    print beside them; the floor that no function of the inputs beats on that set.

    Args:
        versions: "name version" each.

    Raises:
        FileNotFoundError: if weights are missing.
        ValueError: if they are not of the paper's recipe.
    """
    chains = {}
    for (constrained, trained_on), file in SHIPPED.items():
        told = paper_chain(constrained, trained_on).metadata
        if told.get("recipe") != "paper" or "nmse" not in told:
            raise ValueError(f"{file}.safetensors is not of the paper's recipe")
        networks = {}
        for target in TARGETS:
            network = {**told["nmse"][target], "rows": told["rows"][target]}
            if trained_on == "released":
                printed = PRINTED[told["chain"]][target]
                network |= dict(zip(("train_printed", "test_printed"), printed, strict=True))
            networks[target] = network
        chains[file] = {key: told[key] for key in _TOLD} | {"networks": networks}
    return {
        "table": "table1",
        "versions": dict(item.split(" ", 1) for item in versions),
        "chains": chains,
    }


def table_one(whole: Mapping[str, Any]) -> list[TextTable]:
    """What `table_one_figures` found, a table a file."""
    tables = []
    for file, chain in whole["chains"].items():
        notes = [f"({chain['chain']}; {chain['action_level']})"]
        rows = [{"name": name, **network} for name, network in chain["networks"].items()]
        tables.append(TextTable((Column("name", file), *_COLUMNS), rows, notes))
    return tables
