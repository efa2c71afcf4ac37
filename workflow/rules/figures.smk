rule figure:
    input:
        lambda wildcards: list(figure_inputs(CAMPAIGN, wildcards.figure).values()),
    output:
        picture=ensure(results("figures/{figure}.png"), non_empty=True),
        data=ensure(results("figures/{figure}.csv"), non_empty=True),
    params:
        version=FIGURE_VERSION,
        artifacts=lambda wildcards: repeated(
            "artifact", [f"{key}={path}" for key, path in figure_inputs(CAMPAIGN, wildcards.figure).items()]
        ),
    log:
        results("logs/figures/{figure}.log"),
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "figure: {wildcards.figure}"
    shell:
        "warmlens figure {wildcards.figure} {params.artifacts} --output {output.picture:q} > {log:q} 2>&1"
