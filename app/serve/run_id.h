// A run's id: by it a browser keeps what it has not sent yet, so that nothing enters another run.
#pragma once

#include <string>

namespace semfield::app {

/// 32 hexadecimal digits, made once and kept in `run_dir`/run_id beside the folder's place. A folder that was moved
/// keeps its id. A copy, whose original is still where it was, is another run: it gets an id of its own, and its
/// serve_token goes, so that a page of the original does not go on with the copy. Throws as new_token, and write_error.
std::string kept_run_id(const std::string& run_dir);

}  // namespace semfield::app
