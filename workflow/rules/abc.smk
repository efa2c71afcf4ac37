rule abc:
    input:
        summaries=all_chunks("summaries"),
        observed_summary=single("observed_summary"),
        smooth_model=single("smooth_model"),
        null_summaries=all_chunks("null_summaries"),
    output:
        artifact=ensure(single("abc"), non_empty=True),
        table=ensure(results(TABLE), non_empty=True),
        numbers=ensure(results(NUMBERS), non_empty=True),
    params:
        settings=settings("abc"),
        summaries=lambda wildcards, input: repeated("summary", input.summaries),
        null_summaries=lambda wildcards, input: repeated("null-summaries", input.null_summaries),
    log:
        results("logs/abc.log"),
    benchmark:
        results("benchmarks/abc.tsv")
    resources:
        mem_mb=2000,
        runtime=30,
    message:
        "abc: accept samples, bound the relic mass"
    shell:
        "warmlens abc --params {params.settings:q} {params.summaries}"
        " --observed-summary {input.observed_summary:q} --smooth-model {input.smooth_model:q}"
        " {params.null_summaries}"
        " --output {output.artifact:q} --table {output.table:q} --numbers {output.numbers:q} > {log:q} 2>&1"
