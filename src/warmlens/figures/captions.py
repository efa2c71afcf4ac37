"""What each figure shows, in a sentence: campaign figures by name, the paper's by number."""

from __future__ import annotations

from collections.abc import Mapping

_PLANE = (
    "Positions of the scan in the plane of ΔR = R_pert − R_smooth and R_sens (both χ² differences), all bands "
    "together, with the distributions of both above and to the right; ΔR < 0 where a perturber improves the fit; "
    "one colour per campaign, whose observation is scanned, or per mock; the campaigns differ in "
)

CAPTIONS: Mapping[str, str] = {
    "smooth_model": (
        "Observed image, fitted smooth model with critical curves, residuals in units of the noise σ, and "
        "reconstructed source with caustics, one row per band; χ²_red leaves out the circles about the quasar "
        "images, and no pixel sees the grey parts of the source plane."
    ),
    "psf": (
        "Point spread function per band: as given and, where the fit corrected it, as improved, with the "
        "difference (asinh scale) and the profiles against radius [arcsec]; dashed steps are the remaining error."
    ),
    "halo_maps": (
        "Projected mass Σ_sub [M☉ kpc⁻²] of the subhalos of six samples from warm to cold; titles give the "
        "thermal relic mass m_TH [keV] and the halo mass M_h."
    ),
    "deflection_maps": (
        "West component Δα_x [arcsec] of the high-pass filtered deflection by the subhalos of six samples from "
        "warm to cold; titles give m_TH [keV] and M_h."
    ),
    "mocks": (
        "The observation and the coldest mock of the first chunk [e⁻ s⁻¹ px⁻¹], and both less the smooth model in "
        "units of the noise σ, one row per band."
    ),
    "delta_r": (
        "ΔR, the change of χ² + prior when a perturber is put at each position, of the observation and of the "
        "warmest and the coldest mock of the first chunk (blue: the perturber improves the fit), and R_sens of "
        "the observation; one row per band and one for their sum."
    ),
    "scan_plane": (
        "Positions of the observation's scan in the plane of ΔR and R_sens per band and combined, with the "
        "distributions of both above and to the right; on the dotted line the perturber costs as much as it "
        "changes the model, on the dashed line it gains as much."
    ),
    "correlation": (
        "Correlation function C(dr) of ΔR below the threshold against separation dr [arcsec], and fraction of "
        "positions with ΔR below each value: mean and 16th to 84th percentile of all samples in three groups of "
        "equal size in thermal relic mass m_TH, and the observation in black."
    ),
    "posterior": (
        "Left: samples in the plane of thermal relic mass m_TH and halo mass M_h, the accepted ones black, with "
        "the 68.3% and 95.4% highest-density regions; right: marginal distribution of m_TH, the mass range that "
        "the bound excludes shaded, and the bound of the prior alone dashed."
    ),
    "likelihood": (
        "Left: likelihood ratio B(m_TH), 1 at the upper end of the prior, with the 16% to 84% band of the "
        "bootstrapped tables and where it falls to 1/10 and 1/20; right: the bound on m_TH with its Monte-Carlo "
        "error at other levels, under other acceptance rules and other priors, and the bound of each prior alone."
    ),
    "calibration": (
        "Leave-one-out calibration: coverage of the bound by true m_TH with 95% Clopper-Pearson intervals "
        "(nominal dashed), difference of the rank ECDF from uniform with its simultaneous 95% band, and the bound "
        "of each trial against its truth (red: the bound excludes it), with the 68% ranges expected of cold "
        "truths (grey) and of mocks without substructure (orange), and the observed bound dashed."
    ),
    "convergence": (
        "Bound on m_TH against the accepted fraction of the samples, raw and after the regression adjustment, "
        "with Monte-Carlo errors; the upper axis is the accepted number; dashed are the fraction of the inference "
        "and the bound of the prior alone."
    ),
    "predictive": (
        "Posterior predictive check: correlation function C(dr) and cumulative distribution of ΔR of the accepted "
        "samples (median, 68% and 95% bands) over those of the observation, and the probability p that an "
        "accepted sample lies as far from the mean of the others as the observation."
    ),
    "information": (
        "Value of each set of summaries: mean information gain on m_TH over the prior [nat] with its error, the "
        "bound of this observation and the bound expected for cold dark matter [keV], each with its Monte-Carlo "
        "error."
    ),
    "1": (
        "Projected mass Σ_sub [M☉ kpc⁻²] of halos of thermal relic mass 1 to 10 keV (columns) and halo mass 10¹² "
        "to 10¹³·⁵ M☉ (rows), 4″ × 4″; one colour scale per row."
    ),
    "2": (
        "First component Δα₁ [arcsec] of the high-pass filtered deflection by the halos of Fig. 1, full colour at "
        "0.04″; each panel gives its largest deflection."
    ),
    "3": (
        "ΔR of the observation and of cold samples in a heavy and in a light halo, and R_sens of the observation; "
        "one row per band and one for their sum."
    ),
    "4": (
        "Correlation function C(dr) of ΔR below the threshold, one panel per range of halo mass: mean of the "
        "samples of each range of thermal relic mass, some single samples dashed, the observation in black."
    ),
    "5": (
        "Constraints of the campaign. Left: accepted samples with the 68.3% and 95.4% highest-density regions in "
        "the plane of m_TH and M_h; right: marginal distribution of m_TH with the excluded region shaded."
    ),
    "6": _PLANE + "the number of shapelets of the lens potential.",
    "7": _PLANE + "the description of the source: global shapelets, nested ones, clumps.",
    "8": (
        "Cumulative subhalo mass function and v_max function at z = 0 of halos of 10¹²·⁵ M☉, mean of five "
        "realizations (faint) per dark matter model, with published suppression fits (dashed, dotted)."
    ),
}
