# warmlens: from the image of a strong lens to a lower bound on the mass of warm dark matter.
# One rule file a stage; the paths, spans and settings come from the package.
from snakemake.utils import min_version

min_version("9.10")


configfile: "config.yaml"


include: "workflow/rules/common.smk"
include: "workflow/rules/observation.smk"
include: "workflow/rules/smooth_model.smk"
include: "workflow/rules/scan_operator.smk"
include: "workflow/rules/halos.smk"
include: "workflow/rules/deflections.smk"
include: "workflow/rules/mocks.smk"
include: "workflow/rules/scans.smk"
include: "workflow/rules/summaries.smk"
include: "workflow/rules/null_test.smk"
include: f"workflow/rules/{ANSWER}.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/manifest.smk"


rule all:
    default_target: True
    localrule: True
    input:
        # every stage's files, so that a deleted artifact is made again
        list(ARTIFACTS),
        [results(name) for name in ANSWER_FILES[ANSWER]],
        [pictures(names) for names in DRAWN.values()],
        [results(REPORT)] if ANSWER == "abc" else [],
        [str(path) for path in ledgers(CAMPAIGN)],
        results(MANIFEST),
        results(CRATE),
    message:
        "all artifacts, the figures, the report and the manifest are there"
