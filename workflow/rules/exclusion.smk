# In place of `abc` where the samples are the nodes of a grid.
rule exclusion:
    input:
        summaries=all_chunks("summaries"),
        observed_summary=single("observed_summary"),
        smooth_model=single("smooth_model"),
    output:
        artifact=ensure(single("exclusion"), non_empty=True),
        table=ensure(results(EXCLUSION_TABLE), non_empty=True),
        numbers=ensure(results(EXCLUSION_NUMBERS), non_empty=True),
    params:
        settings=settings("exclusion"),
        summaries=lambda wildcards, input: repeated("summary", input.summaries),
    log:
        results("logs/exclusion.log"),
    benchmark:
        results("benchmarks/exclusion.tsv")
    resources:
        mem_mb=2000,
        runtime=30,
    message:
        "exclusion: accept samples, count them on the nodes"
    shell:
        "warmlens exclusion --params {params.settings:q} {params.summaries}"
        " --observed-summary {input.observed_summary:q} --smooth-model {input.smooth_model:q}"
        " --output {output.artifact:q} --table {output.table:q} --numbers {output.numbers:q} > {log:q} 2>&1"
