"""The command `drake-oa`.

In: scenarios by name or file, logs, depth images, options; out: tables on stdout, messages,
progress and errors on stderr, files that are named. Each command is a typed function: cyclopts
reads its signature for the options and its docstring for the help, which is written for users.

    run                 both motions of a scenario, judged; a log, a report, a recording
    replay, plot        a log, shown again and drawn; what demonstrations teach, drawn
    scenarios, graph    what is shipped; how it is wired
    perceive            table, clusters and ellipsoids of recorded frames
    benchmark           real-time factors, layers, decisions (`drake_oa.benchmark`)
    evaluate            methods on suites of scenes (`drake_oa.evaluation`); below it `panda`, `mbm`,
                        `table1` and so on, the paper's tables and figures (`paper_tables`)
    train               the networks (`drake_oa.training`)

A module is imported when its command is asked for, and what computes when it is needed: `--help`
and `scenarios` import neither NumPy nor Drake. Tables and progress are rich's on a terminal and
plain text elsewhere (`drake_oa.common.console`).

Exit statuses: 0 done, 1 failed (an avoiding motion that did not arrive or was in contact, a table
that was not found, a file that could not be written), 2 bad input, told in one line "drake-oa:
error: ..." (with --verbose after a traceback), 130 interrupted, 143 terminated.

Read `main` first.
"""
