"""The command line of a checkout: ``python launch.py --config demo.yaml --train``; see threestudio_gaussiandreamer/experiment.py."""

from threestudio_gaussiandreamer.experiment import console

if __name__ == "__main__":
    console()
