"""Evaluates a run's best checkpoint on held-out tasks, with floors and ceiling.

python -m milx.evaluate --workdir=runs/reach-mil-fast-0
python -m milx.evaluate --workdir=runs/reach-mil-fast-0 --config.evaluation.shots=5
"""
