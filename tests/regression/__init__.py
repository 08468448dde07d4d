"""Regression checks of avoiding motions against stored results.

`make regression` runs every shipped scenario with a robot to its end: seeds 0 to 2 from the
scenario's own perception, seed 0 from ground truth. `make regression-suites` runs random scenes,
benchmark problems and the paper's tables. Both compare run by run with the files beside this
module, and resume after an interruption.

    python -m tests.regression scenarios    compare with scenarios.json
    python -m tests.regression suites       compare with suites.json and tables.json
    python -m tests.regression suites --write     replace the stored results

Stored results are replaced only in a commit of their own that explains each difference.
"""
