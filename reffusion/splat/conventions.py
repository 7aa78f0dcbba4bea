"""The constants of the splatting model, shared by its implementations (docs/method.md#splatting)."""

NEAR = 0.01  # camera z below which a Gaussian is culled, in units of the normalized frame
LOW_PASS = 0.3  # px^2 added to the diagonal of the 2D covariance
MIN_ALPHA = 1.0 / 255.0  # a Gaussian is skipped at the pixels where its alpha is smaller
MAX_ALPHA = 0.999  # larger alphas are clamped, with zero gradient; gsplat has the same value compiled in
MIN_TRANSMITTANCE = 1e-4  # a Gaussian that would bring the transmittance below is not blended, and ends the pixel
JACOBIAN_MARGIN = 0.3  # in the Jacobian, x/z and y/z are clamped at the image border + this share of half the image
MAX_PIXELS = 1e7  # Gaussians whose 2D mean is farther than this from the image are culled
MAX_VARIANCE = 1e30  # px^2; Gaussians with a larger 2D variance are culled

# Real spherical harmonics in the order and with the signs of 3DGS.
SH0 = 0.28209479177387814
SH1 = 0.4886025119029199
SH2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
