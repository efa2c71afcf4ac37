rule abc:
    input:
        unpack(inputs("abc")),
    output:
        artifact=ensure(output("abc"), non_empty=True),
        beside=ensure([results(name) for name in ANSWER_FILES["abc"]], non_empty=True),
    params:
        settings=settings("abc"),
        inputs=input_words,
    log:
        note("logs", "abc"),
    benchmark:
        note("benchmarks", "abc")
    resources:
        mem_mb=answer_memory_mb(CAMPAIGN),
        runtime=30,
    message:
        "abc: accept samples, bound the relic mass"
    shell:
        command("abc")
