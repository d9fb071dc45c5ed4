"""Networks that others trained, in ONNX format: detectors, a predictor, and a catalogue of weights to fetch.

``network`` is the one door to them: it runs each in a process of its own, by ``session`` (ONNX Runtime), ``graph``
(reads files), and ``child`` (the other process, from both sides). ``predictor`` and ``detector`` are what is chosen by
name. ``pictures`` opens the network of a detector and runs it; ``layouts`` knows what families of
networks take and give; ``nms`` puts pictures and tiles into the input, and suppresses boxes of the same object.
``catalogue`` lists detectors, and ``api`` fetches their weights.
"""
