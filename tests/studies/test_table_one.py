"""Table I of the paper, from the metadata of the shipped weights."""

import pytest

from drake_oa.regulation.regressor import TARGETS
from drake_oa.studies.paper_tables import table_one, table_one_figures


def test_the_shipped_chains_reach_the_print() -> None:
    whole = table_one_figures()
    chains = whole["chains"]
    assert list(chains) == ["paper_chain", "paper_chain_unconstrained", "paper_chain_running"]
    for file in ("paper_chain", "paper_chain_unconstrained"):
        for target in TARGETS:
            network = chains[file]["networks"][target]
            for part in ("train", "test"):
                printed = network[f"{part}_printed"]
                # Within 2 % of the print, or better.
                assert network[part] < 1.02 * printed
                assert network[part] == pytest.approx(printed, rel=0.02) or target == "alpha"
    assert "train_printed" not in chains["paper_chain_running"]["networks"]["kappa"]
    tables = table_one(whole)
    assert [table.columns[0].heading for table in tables] == list(chains)
    kappa = ["kappa", "0.54", "0.539", "0.541", "0.543", "0.54", "1,218,714"]
    assert str(tables[1]).splitlines()[1].split() == kappa
    assert "print" not in str(tables[2])
