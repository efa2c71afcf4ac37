# Several figures a job; a figure of a finished campaign by itself: warmlens figure NAME --results FOLDER
for group, names in DRAWN.items():

    rule:
        name:
            f"figures_{group}"
        input:
            unique(path for figure in names for path in figure_inputs(CAMPAIGN, figure).values()),
        output:
            ensure(pictures(names), non_empty=True),
            ensure([results(LEDGER.format(name=name)) for name in names], non_empty=True),
        params:
            version=FIGURE_VERSION,
            folder=CAMPAIGN.results,  # whose configuration the artifacts are checked against
            names=names,
        log:
            results(f"logs/figures/{group}.log"),
        benchmark:
            results(f"benchmarks/figures/{group}.tsv")
        resources:
            mem_mb=2000,
            runtime=20,
        message:
            f"figures: {', '.join(names)}"
        shell:
            "warmlens figures {params.folder:q} {params.names} > {log:q} 2>&1"
