# Figures of maps show samples of the first chunk; those of the whole table read every chunk.
def first(stage):
    return [f"{stage}={all_chunks(stage)[0]}"]


def every(stage):
    return [f"{stage}/{i}={path}" for i, path in enumerate(all_chunks(stage))]


def one(stage):
    return [f"{stage}={single(stage)}"]


FIGURE_ARTIFACTS = {
    "smooth_model": one("observation") + one("smooth_model"),
    "psf": one("observation") + one("smooth_model"),
    "halo_maps": first("halos"),
    "deflection_maps": one("observation") + first("deflections"),
    "mocks": one("observation") + one("smooth_model") + first("mocks"),
    "delta_r": one("observed_scan") + first("scans"),
    "scan_plane": one("observed_scan"),
    "correlation": one("observed_summary") + every("summaries"),
    "posterior": one("abc"),
}


rule figure:
    input:
        lambda wildcards: [item.partition("=")[2] for item in FIGURE_ARTIFACTS[wildcards.figure]],
    output:
        ensure(results("figures/{figure}.png"), non_empty=True),
    params:
        version=FIGURE_VERSION,
        artifacts=lambda wildcards: repeated("artifact", FIGURE_ARTIFACTS[wildcards.figure]),
    log:
        results("logs/figures/{figure}.log"),
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "figure: {wildcards.figure}"
    shell:
        "warmlens figure {wildcards.figure} {params.artifacts} --output {output:q} > {log:q} 2>&1"
