// The state of a session as JSON, as the page follows it.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "app/serve/http_server.h"
#include "app/serve/page_source.h"
#include "core/error.h"

namespace semfield::app {

/// One export, as the page shows it.
struct ExportState {
  std::string id;
  std::string what;                ///< export_name()
  std::string state = "waiting";   ///< then "running", then "done", "failed" or "canceled"
  std::string text;                ///< a short sentence
  std::vector<std::string> files;  ///< names, when it is done
};

struct PageRevision {
  std::uint64_t first = 0;  ///< PageOptions::first_revision
  std::uint64_t now = 0;    ///< what the client gives back as `after`
};

/// `run_id`: kept_run_id(). `known`: the session's revision that the client has seen, 0 for none: marks and history
/// that are no newer are null.
std::string state_json(const LabelState& state, const PageSource& source, const std::vector<ExportState>& exports,
                       const std::string& run_id, std::uint64_t known, const PageRevision& revision);

/// {"position", "rotation", "fov_deg"}, as requests for pictures of a free camera state it.
std::string camera_json(const FreeCamera& camera);

/// {"error", "code", "remedy"}.
std::string error_json(Code code, const std::string& message, const std::string& remedy);
/// What `answer` returns, or what it throws as such a response: what the client did wrong is 400; what could not be
/// kept or made now is 503.
HttpResponse safe_answer(const std::function<HttpResponse()>& answer) noexcept;
/// 405 at an address that takes another method.
HttpResponse wrong_method(const char* allowed);

// A run's id: by it a browser keeps what it has not sent yet, so that nothing enters another run.

/// 32 hexadecimal digits, made once and kept in `run_dir`/run_id beside the folder's place. A folder that was moved
/// keeps its id. A copy, whose original is still where it was, is another run: it gets an id of its own, and its
/// serve_token goes, so that a page of the original does not go on with the copy. Throws as new_token, and write_error.
std::string kept_run_id(const std::string& run_dir);

}  // namespace semfield::app
