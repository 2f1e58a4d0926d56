"""Analysis of closed loops without simulation: proved bounds and exactly computed properties.

The package converts a closed loop to one of two forms.

* A loop whose sends reset an error is a Markov chain of this error (``renewal``). ``taciturn.renewal`` computes its
  rate and cost, and ``limits`` computes a lower bound on the cost of all schedules of the same controller.
* A loop of linear steps with one trigger is a switched linear map z⁺ = F_i z + G w (``switched``). ``reduction``
  removes the states that noise does not reach or that affect neither cost nor trigger. ``certificates`` proves decay,
  gain and cost by quadratic functions V(z) = z'Pz. ``inequalities`` represents the matrix inequalities as data. A
  solver proposes a solution, and a floating-point check with bounds on rounding errors accepts or rejects it.

``outcomes`` treats loops over links that drop packets as jump linear maps. Their second and fourth moments determine
whether the average cost exists and whether its standard error is reliable.
"""
