"""Temporal segment models: learn a distribution over whole segments of the future, and plan through it.

A dynamics model maps a past segment of states and actions, and the actions planned next, to the states that follow
(Mishra, Abbeel and Mordatch, "Prediction and Control with Temporal Segment Models", ICML 2017). A one-step model is a
segment model of length one. Data flows one way: ``envs`` -> ``collect`` -> ``trajectory`` -> models -> ``train`` ->
``evaluate``, ``trajopt`` and ``figures``. Import what you need from these modules; nothing is re-exported here.
"""

__version__ = "0.1.0"
