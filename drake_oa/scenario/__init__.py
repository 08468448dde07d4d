"""The scenario: everything a run needs, in one typed YAML file.

In: the text of a file, with overrides "field.subfield=value". Out: a `Scenario`, whose blocks are
the layers' own configurations; each field has a default, a unit and a range, which are checked
once, when it is read. An error names the field and what would be valid.

    task           start, goal, demonstrations, requested clearance     `task.Task`
    policy         movement primitive and coupling terms            `scenario.Policy`
    robot          model, tool, gains, posture                      `robot.config.Robot`
    perception     tagged: where obstacles come from    `perception.config`, `perception`
    inference     tagged: !Verified or !Paper                  `inference.config`
    guard                                                           `safety.config`
    cameras, directives                                             Drake's own
    obstacles, faults                                               `obstacles`, `faults`

What follows from several blocks is here too: the joints at start and goal (`end_poses`), the
tool's orientation along the motion (`end_poses`), what demonstrations teach
(`demonstration`), periods and margins of a perception block (`sources`). Only `diagrams`,
`world`, `runs` and what is above them know a scenario; a layer is made from its block.

Read `scenario` first, then `loading`.
"""
