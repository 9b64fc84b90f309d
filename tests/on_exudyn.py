"""Exudyn of any version from 1.13: terms of a tree of hinges and slides, in one object of minimal coordinates."""

import exudyn as exu
import exudyn.utilities as eu
import numpy as np

KINDS = {"revolute": exu.JointType.RevoluteZ, "prismatic": exu.JointType.PrismaticZ}


def parallel(m, c):
    return m * (c @ c * np.eye(3) - np.outer(c, c))


def built(data):
    """Return the links, each with its joint's axis as z and all that is fixed to it, their names, and gravity."""
    frames, links, names = {"world": (-1, np.eye(3), np.zeros(3))}, [], {}
    for joint in data["joints"]:
        k, R, p = frames[joint["parent"]]
        p, R = p + R @ np.array(joint["translation"]), R @ np.array(joint["rotation"])
        names[joint["name"]] = []
        for step in joint["steps"]:
            if step["type"] not in KINDS or any(joint["rotors"]):
                raise NotImplementedError(f"joint {joint['name']!r} is {step['type']}, or has a rotor")
            z = np.array(step["axes"][0])
            x = np.linalg.svd(z[None])[2][1]
            C = np.column_stack([x, np.cross(z, x), z])
            link = {"kind": KINDS[step["type"]], "parent": k, "A": R @ C, "p": p}
            links.append(link | {"m": 0.0, "mc": np.zeros(3), "I": np.zeros((3, 3))})
            k, R, p = len(links) - 1, C.T, np.zeros(3)
            names[joint["name"]].append(k)
        frames[joint["child"]] = (k, R, p)
        if k >= 0:
            body, link = data["bodies"][joint["child"]], links[k]
            c, m = p + R @ np.array(body["com"]), body["mass"]
            link["m"], link["mc"] = link["m"] + m, link["mc"] + m * c
            link["I"] = link["I"] + R @ np.array(body["inertia"]) @ R.T + parallel(m, c)
    return links, names, data["gravity"]


class Engine:
    def __init__(self, parts):
        links, self._names, gravity = parts
        self._all, self._solver, zero = exu.SystemContainer(), exu.MainSolverImplicitSecondOrder(), [0.0] * len(links)
        self._mbs = self._all.AddSystem()
        coms = [x["mc"] / x["m"] if x["m"] else np.zeros(3) for x in links]
        tree = eu.ObjectKinematicTree(
            nodeNumber=self._mbs.AddNode(eu.NodeGenericODE2("", zero, zero, zero, len(links))),
            jointTypes=[x["kind"] for x in links],
            linkParents=[x["parent"] for x in links],
            jointTransformations=exu.Matrix3DList([x["A"] for x in links]),
            jointOffsets=exu.Vector3DList([x["p"] for x in links]),
            linkMasses=[x["m"] for x in links],
            linkCOMs=exu.Vector3DList(coms),
            linkInertiasCOM=exu.Matrix3DList([x["I"] - parallel(x["m"], c) for x, c in zip(links, coms, strict=True)]),
            gravity=gravity,
        )
        self._mbs.AddObject(tree)
        self._mbs.Assemble()
        self._solver.InitializeSolver(self._mbs, exu.SimulationSettings())

    def joints(self):
        return {name: [own, own] for name, own in self._names.items()}

    def _set(self, q, v):
        self._mbs.systemData.SetODE2Coordinates(q, exu.ConfigurationType.Current)
        self._mbs.systemData.SetODE2Coordinates_t(v, exu.ConfigurationType.Current)

    def mass_matrix(self, q):
        self._set(q, 0 * q)
        self._solver.ComputeMassMatrix(self._mbs)
        return np.array(self._solver.GetSystemMassMatrix())

    def nle(self, q, v):
        self._set(q, v)
        self._solver.ComputeODE2RHS(self._mbs)
        return -np.array(self._solver.GetSystemResidual())

    def gravity(self, q):
        return self.nle(q, 0 * q)
