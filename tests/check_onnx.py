#!/usr/bin/env python3
"""Prints what onnxruntime makes of a law at states: one line a state, u, then V and p where the model has them.

    python tests/check_onnx.py MODEL.onnx STATES x1 x2 ... (numbers of all states in turn)

Needs onnxruntime and numpy. All states are one batch; the first alone must give the same.
"""

import sys

import numpy as np
import onnxruntime

model, width = sys.argv[1], int(sys.argv[2])
states = np.array([float(v) for v in sys.argv[3:]]).reshape(-1, width)
session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
names = [output.name for output in session.get_outputs()]
assert [i.name for i in session.get_inputs()] == ["x"], session.get_inputs()
assert names in (["u"], ["u", "V", "p"]), names
together = np.hstack(session.run(names, {"x": states}))
alone = np.hstack(session.run(names, {"x": states[:1]}))
assert together.dtype == np.float64 and together.shape[0] == len(states), together.shape
# Products may be summed in another order for a batch.
assert np.allclose(together[0], alone[0], rtol=1e-13, atol=1e-13), (together[0], alone[0])
for row in together:
    print(*(repr(float(v)) for v in row))
