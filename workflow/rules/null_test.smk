# Mocks without substructure: they go through the same steps as any other mock, then each plays the observation.
rule null_mocks:
    input:
        unpack(inputs("null_mocks")),
    output:
        ensure(output("null_mocks"), non_empty=True),
    params:
        settings=settings("null_mocks"),
        inputs=input_words,
    log:
        note("logs", "null_mocks"),
    benchmark:
        note("benchmarks", "null_mocks")
    resources:
        mem_mb=1000,
        runtime=60,
        sample_seconds=SAMPLE_SECONDS,
    message:
        "null test: mocks without substructure"
    shell:
        command("null_mocks", TIMED)


rule null_scans:
    input:
        unpack(inputs("null_scans")),
    output:
        ensure(output("null_scans"), non_empty=True),
    params:
        settings=settings("null_scans"),
        inputs=input_words,
    log:
        note("logs", "null_scans"),
    benchmark:
        note("benchmarks", "null_scans")
    resources:
        mem_mb=3000,
        runtime=120,
    message:
        "null test: scans"
    shell:
        command("null_scans")


rule null_summaries:
    input:
        unpack(inputs("null_summaries")),
    output:
        ensure(output("null_summaries"), non_empty=True),
    params:
        settings=settings("null_summaries"),
        inputs=input_words,
    log:
        note("logs", "null_summaries"),
    benchmark:
        note("benchmarks", "null_summaries")
    resources:
        mem_mb=1000,
        runtime=30,
    message:
        "null test: summaries"
    shell:
        command("null_summaries")
