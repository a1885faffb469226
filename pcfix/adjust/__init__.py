"""Bundle adjustment with refraction, a chapter in each file.

1. Observations (`block`): images of tie points and control points, GNSS positions, water or port.
2. Functional model (`parameters`, `collinearity`): the image of a point through the water, and its
   derivatives by pose, point, lens, water and port.
3. Least squares (`problem`, `normal`, `solve`): prior knowledge and datum, normal equations without
   the points, Levenberg-Marquardt steps.
4. Strategies: robust rounds and the choice of lens parameters with measured tie points
   (`from_ties`); without them, undoing an adjustment that did not know of the water (`from_cloud`).
   `methods` chooses between the two, and checks what goes in and out.
5. Precision (`precision`): covariances, errors that observations share, an ensemble; `result`.
6. Diagnosis (`diagnosis`): have poses absorbed the refraction?
7. Transfer (`transfer`): a cloud of the original poses as it would be with the adjusted ones.

The theory is that of Triggs et al. 2000 (Bundle adjustment: a modern synthesis), the refraction
that of Mulsow 2024.
"""
