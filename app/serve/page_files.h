// What a page has on the disk: its own files, and the secret and the id of its run.
#pragma once

#include <map>
#include <string>

namespace semfield::app {

/// 32 hexadecimal digits of 128 random bits from the kernel. Throws Error(unavailable) where it has none.
std::string new_token();

/// The token of a run: made once and kept in `run_dir`/serve_token, for its user alone, so that a page that is open
/// goes on when the program starts again. One that others may read is replaced. Throws as new_token, and write_error.
std::string kept_token(const std::string& run_dir);

// The page's own files, read once: what is not in the list is not there.

struct PageFile {
  std::string type;  ///< MIME
  std::string bytes;
};

/// Files of `folder` by name: scripts, styles, pages and pictures; "" is index.html. Throws Error(no_input) where the
/// folder or its index.html is missing.
std::map<std::string, PageFile> read_page_files(const std::string& folder);

// A run's id: by it a browser keeps what it has not sent yet, so that nothing enters another run.

/// 32 hexadecimal digits, made once and kept in `run_dir`/run_id beside the folder's place. A folder that was moved
/// keeps its id. A copy, whose original is still where it was, is another run: it gets an id of its own, and its
/// serve_token goes, so that a page of the original does not go on with the copy. Throws as new_token, and write_error.
std::string kept_run_id(const std::string& run_dir);

}  // namespace semfield::app
