"""Analysis of closed loops without simulation: proven bounds and exactly computed properties.

The package converts a closed loop to one of three forms.

* A loop whose sends reset an error is a Markov chain of this error (``renewal``). ``taciturn.renewal`` computes its
  rate and cost.
* A loop of linear steps with one trigger is a switched linear map z⁺ = F_i z + G w (``switched``), without the states
  that noise does not reach or that affect neither cost nor trigger. A loop over links that drop packets is a jump
  linear map. Its second and fourth moments determine whether the average cost exists and whether its standard error is
  reliable.
* A loop in which every node sends every sample is a linear map, with an exact cost, that a simulation can run on the
  random numbers of the loop itself (``every_sample``).
"""
