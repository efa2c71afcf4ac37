def observation_files():
    if CAMPAIGN.observation.kind == "simulated":
        return []
    from warmlens.products.images import artifact_path, input_files

    try:
        if CAMPAIGN.observation.kind == "artifact":
            return [str(artifact_path(CAMPAIGN.observation))]
        blocks = [CAMPAIGN.observation.fits[band] for band in CAMPAIGN.observation.bands]
        return [str(path) for block in blocks for path in input_files(block).values()]
    except ConfigError as error:
        raise WorkflowError(str(error)) from None


rule observation:
    input:
        unpack(inputs("observation")),
        # their digests are compared at every start: a copy, or an older file, has another time
        [ancient(path) for path in observation_files()],
    output:
        ensure(output("observation"), non_empty=True),
    params:
        settings=settings("observation"),
    log:
        note("logs", "observation"),
    benchmark:
        note("benchmarks", "observation")
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "observation: read, simulate or copy the image"
    shell:
        command("observation")
