"""Scenario: all parameters of a run, which are read from one typed YAML file.

Input: the text of a file, with overrides "field.subfield=value". Output: a `Scenario`, whose blocks
are the configurations of the layers. Each field has a default, a unit and a range, checked when the
file is read. An error names the field and its valid values.

Each line has a block, its content, and the module of this package or of `drake_oa` that defines it.
A tagged block has a YAML tag, such as !Verified, that selects one of several types:

    task           start, goal, demonstrations, requested clearance   `task.Task`
    policy         movement primitive and coupling terms              `policy.config.Policy`
    robot          model, tool, gains, nominal posture                `robot.config.Robot`
    perception     tagged: source of the obstacles       `perception.config`, `perception`
    inference      tagged: !Verified or !Paper                        `inference.config`
    guard          maneuvers, contact reaction, speed limits          `safety.config`
    cameras, directives                                               defined by Drake
    obstacles, faults                                                 `obstacles`, `faults`

The package also computes values that follow from several blocks: configurations and tool
orientations at start and goal (`end_poses`), movement primitives of demonstrations
(`demonstration`), and the observation period and other values that follow from a perception block
(`sources`). Only `diagrams`, `world`, `runs` and the packages above them import a scenario. A layer
is built from its block alone, without the rest of the scenario.

Read `scenario` first, then `loading`.
"""
