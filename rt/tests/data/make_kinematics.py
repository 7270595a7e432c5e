"""Makes kinematics_pin.csv with Pinocchio (PyPI `pin` 4.1.0), which shares no code with this repository.

Each arm is built there as a chain of revolute joints with fixed placements from the DH table printed below. A row holds the
model's name, six joint positions, the flange position and rotation matrix (row by row) in UR's base frame, and the body
Jacobian at the flange (row by row, [v; w], expressed in the flange frame: Pinocchio's LOCAL).

    pip install pin==4.1.0 && python make_kinematics.py > kinematics_pin.csv
"""

import numpy as np
import pinocchio as pin

MODELS = {  # d1, a2, a3, d4, d5, d6: Universal Robots' article on DH parameters, and its ROS 2 description for UR3, UR5, UR10
    "ur3": [0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819],
    "ur5": [0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823],
    "ur10": [0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922],
    "ur3e": [0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921],
    "ur5e": [0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996],
    "ur10e": [0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655],
    "ur16e": [0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655],
    "ur20": [0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543],
    "ur30": [0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543],
}
ALPHA = [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]


def rot_x(a):
    return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


def build(d1, a2, a3, d4, d5, d6):
    a = [0, a2, a3, 0, 0, 0]
    d = [d1, 0, 0, d4, d5, d6]
    model = pin.Model()
    parent, place = 0, pin.SE3.Identity()
    for i in range(6):
        parent = model.addJoint(parent, pin.JointModelRZ(), place, f"joint{i}")
        place = pin.SE3(rot_x(ALPHA[i]), np.array([a[i], 0, d[i]]))
    model.addFrame(pin.Frame("flange", parent, 0, place, pin.FrameType.OP_FRAME))
    return model


rng = np.random.default_rng(20)
for name, lengths in MODELS.items():
    model = build(*lengths)
    data = model.createData()
    flange = model.getFrameId("flange")
    for _ in range(6):
        q = rng.uniform(-3.1, 3.1, 6)
        pin.framesForwardKinematics(model, data, q)
        jac = pin.computeFrameJacobian(model, data, q, flange, pin.ReferenceFrame.LOCAL)
        pose = data.oMf[flange]
        row = [*q, *pose.translation, *pose.rotation.ravel(), *jac.ravel()]
        print(name + "," + ",".join(f"{v:.12g}" for v in row))
