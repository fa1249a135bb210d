"""The experiments of the paper and some beyond it, each one module that makes figures, numbers and
a Rerun recording.

"The paper" is Huang, Rozo, Silvério, Caldwell: Non-parametric Imitation Learning of Robot Motor
Skills, ICRA 2019.
"""
