rule observed_summary:
    input:
        unpack(inputs("observed_summary")),
    output:
        ensure(output("observed_summary"), non_empty=True),
    params:
        settings=settings("observed_summary"),
        inputs=input_words,
    log:
        note("logs", "observed_summary"),
    benchmark:
        note("benchmarks", "observed_summary")
    resources:
        mem_mb=1000,
        runtime=10,
    message:
        "summary of the observation"
    shell:
        command("observed_summary")


rule summaries:
    input:
        unpack(inputs("summaries")),
    output:
        ensure(output("summaries"), non_empty=True),
    params:
        settings=settings("summaries"),
        inputs=input_words,
    log:
        note("logs", "summaries"),
    benchmark:
        note("benchmarks", "summaries")
    resources:
        mem_mb=1000,
        runtime=30,
    message:
        "summaries: samples {wildcards.start} to {wildcards.stop}"
    shell:
        command("summaries")
