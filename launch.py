"""The command line of a checkout: ``python launch.py --config demo.yaml --train``; see
threestudio_gaussiandreamer/launch/experiment.py.
"""

from threestudio_gaussiandreamer.launch.experiment import console

if __name__ == "__main__":
    console()
