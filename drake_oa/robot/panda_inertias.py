"""A second set of inertial parameters of the Panda: what its CAD model suggests.

The package's model has the identified ones (C. Gaz et al., IEEE RA-L 4(4), 2019). The set
here takes each link for a body of uniform density in the shape of its collision mesh, 18 kg
without the hand (M. Krizmancic, franka_gazebo, README and panda_arm.xacro); Drake's own Panda
has it. A controller that goes by it is off by what one without identification could be.
"""

from __future__ import annotations

from xml.etree import ElementTree

from drake_oa.common.config import ScenarioError

_DRAKE = "http://drake.mit.edu"

# Mass [kg]; centre of mass in the link's frame [m]; xx, yy, zz, xy, xz, yz about it [kg m^2].
UNIFORM_DENSITY: dict[str, tuple[float, tuple[float, ...], tuple[float, ...]]] = {
    "panda_link0": (
        2.92,
        (-0.025566, -2.88e-05, 0.057332),
        (
            0.00782229414331,
            0.0109027971813,
            0.0102355503949,
            -1.56191622996e-05,
            -0.00126005738123,
            1.08233858202e-05,
        ),
    ),
    "panda_link1": (
        2.74,
        (0.0, -0.0324958, -0.0675818),
        (0.0180416958283, 0.0159136071891, 0.00620690827127, 0.0, 0.0, 0.0046758424612),
    ),
    "panda_link2": (
        2.74,
        (0.0, -0.06861, 0.0322285),
        (0.0182856182281, 0.00621358421175, 0.0161514346309, 0.0, 0.0, -0.00472844221905),
    ),
    "panda_link3": (
        2.38,
        (0.0469893, 0.0316374, -0.031704),
        (
            0.00771376630908,
            0.00989108008727,
            0.00811723558464,
            -0.00248490625138,
            -0.00332147581033,
            -0.00217796151484,
        ),
    ),
    "panda_link4": (
        2.38,
        (-0.0360446, 0.0336853, 0.031882),
        (
            0.00799663881132,
            0.00825390705278,
            0.0102515004345,
            0.00347095570217,
            -0.00241222942995,
            0.00235774044121,
        ),
    ),
    "panda_link5": (
        2.74,
        (0.0, 0.0610427, -0.104176),
        (
            0.030371374513,
            0.0288752887402,
            0.00444134056164,
            6.50283587108e-07,
            -1.05129179916e-05,
            -0.00775653445787,
        ),
    ),
    "panda_link6": (
        1.55,
        (0.0510509, 0.009108, 0.0106343),
        (
            0.00303336450376,
            0.00404479911567,
            0.00558234286039,
            -0.000437276865508,
            0.000629257294877,
            0.000130472021025,
        ),
    ),
    "panda_link7": (
        0.54,
        (0.0109695, 0.0107965, 0.0650411),
        (
            0.000888868887021,
            0.000888001373233,
            0.0007176834609,
            -0.00012239074652,
            3.98699829666e-05,
            -9.33825115206e-05,
        ),
    ),
    "panda_hand": (
        0.73,
        (0.0, 0.0015244, 0.0275912),
        (0.00278560230025, 0.000400033405336, 0.00256378041832, 0.0, 0.0, 0.0),
    ),
    "panda_leftfinger": (
        0.1,
        (0.0, 0.0145644, 0.0227941),
        (3.01220925051e-05, 2.95873808038e-05, 6.95125211657e-06, 0.0, 0.0, 0.0),
    ),
    "panda_rightfinger": (
        0.1,
        (0.0, 0.0145644, 0.0227941),
        (3.01220925051e-05, 2.95873808038e-05, 6.95125211657e-06, 0.0, 0.0, 0.0),
    ),
}


def with_uniform_density(urdf: str) -> str:
    """A URDF of the Panda with its links' inertial parameters replaced.

    Args:
        urdf: text of the model; links are named as in Franka's description.

    Returns:
        The text with every inertial block of `UNIFORM_DENSITY`'s links replaced.

    Raises:
        ScenarioError: if the model lacks one of the arm's links.
    """
    # Otherwise it would be written under a name that Drake does not know.
    ElementTree.register_namespace("drake", _DRAKE)
    root = ElementTree.fromstring(urdf)
    links = {link.get("name", ""): link for link in root.iter("link")}
    missing = [name for name in UNIFORM_DENSITY if name not in links]
    if missing:
        raise ScenarioError(
            f"faults: !ModelError knows the Panda; robot.model has no {', '.join(missing)}"
        )
    for name, (mass, com, moments) in UNIFORM_DENSITY.items():
        link = links[name]
        for old in link.findall("inertial"):
            link.remove(old)
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=" ".join(map(repr, com)))
        ElementTree.SubElement(inertial, "mass", value=repr(mass))
        names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        values = dict(zip(names, map(repr, moments), strict=True))
        ElementTree.SubElement(inertial, "inertia", values)
    return ElementTree.tostring(root, encoding="unicode")
