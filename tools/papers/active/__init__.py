"""The experiments of paper 004, sections 3 and 4.3: guarantee, quadrotor, helicopter."""
