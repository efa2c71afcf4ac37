rule figure:
    input:
        lambda wildcards: list(figure_inputs(CAMPAIGN, wildcards.figure).values()),
    output:
        picture=ensure(results("figures/{figure}.png"), non_empty=True),
        data=ensure(results("figures/{figure}.csv"), non_empty=True),
    params:
        version=FIGURE_VERSION,
        folder=CAMPAIGN.results,  # whose configuration the artifacts are checked against
    log:
        results("logs/figures/{figure}.log"),
    benchmark:
        results("benchmarks/figures/{figure}.tsv")
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "figure: {wildcards.figure}"
    shell:
        "warmlens figure {wildcards.figure} --results {params.folder:q} --output {output.picture:q} > {log:q} 2>&1"
