"""`walop-jax diagnose --why NAME RUN` answers from the folder, without a fit."""

import json

from handmade_run import DIAGNOSIS

from walop_jax.diagnosis.reasons import why


def test_the_program_answers_from_the_folder(call, tmp_path):
    (tmp_path / "diagnosis.json").write_text(json.dumps(DIAGNOSIS))
    done = call("diagnose", "--why", "ghost", tmp_path)
    assert done.exit_code == 0, done.output
    assert done.stdout == f"{why(DIAGNOSIS, 'ghost')}\n"
    asked = json.loads(call("diagnose", "--why", "ghost", tmp_path, "--json").stdout)
    assert asked == {"name": "ghost", "answer": why(DIAGNOSIS, "ghost").splitlines()}
    wrong = call("diagnose", "--why", "gohst", tmp_path)
    assert wrong.exit_code == 1
    assert "did you mean 'ghost'" in wrong.stderr
    missing = call("diagnose", tmp_path / "night.fits")
    assert missing.exit_code == 2
    assert "Missing option '--output' / '-o'" in missing.stderr
