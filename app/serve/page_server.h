// Pages over HTTP: every address below the secret folder, and what it returns.
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <initializer_list>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "app/app_context.h"
#include "app/serve/http_server.h"
#include "app/serve/page_exports.h"
#include "core/non_copyable.h"
#include "labels/serve/label_session.h"

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

using PageFiles = std::map<std::string, PageFile>;

/// The shipped files of the pages by name: scripts, styles, pages and pictures; "" is `index`.html. Throws
/// Error(no_input) where they are missing.
PageFiles read_page_files(const std::string& index);

// A run's id: by it a browser keeps what it has not sent yet, so that nothing enters another run.

/// 32 hexadecimal digits, made once and kept in `run_dir`/run_id beside the folder's place. A folder that was moved
/// keeps its id. A copy, whose original is still where it was, is another run: it gets an id of its own, and its
/// serve_token goes, so that a page of the original does not go on with the copy. Throws as new_token, and write_error.
std::string kept_run_id(const std::string& run_dir);

// What is answered.

/// {"error", "code", "remedy"}.
std::string error_json(Code code, const std::string& message, const std::string& remedy);
/// Texts of files and folders may be no UTF-8; numbers that are none become null.
HttpResponse json_answer(const Json& json);
HttpResponse bytes_answer(std::string bytes);
/// Parts of an answer, each behind its length in four bytes, little-endian.
std::string joined_parts(std::initializer_list<std::string_view> parts);
HttpResponse jpeg_answer(const std::vector<std::uint8_t>& jpeg);
/// What `answer` returns, or what it throws as such a response: what the client did wrong is 400; what could not be
/// kept or made now is 503.
HttpResponse safe_answer(const std::function<HttpResponse()>& answer) noexcept;

/// Requests for news, each of which waits until there is some.
class News : NonCopyable {
 public:
  /// `longest_ms`: how long one waits; those that wait leave half of the `responses` to the others.
  explicit News(int longest_ms = 20000, int responses = HttpOptions().responses)
      : longest_(longest_ms), responses_(responses) {}

  /// Returns when `look` has found news. `look` waits for them, for `left` at most, and returns whether there are some;
  /// where `left` is 0, at the latest when the time is over, it takes what there is. `at_once`: so at its first call.
  void wait(const HttpRequest& request, bool at_once, const std::function<bool(std::chrono::milliseconds left)>& look);
  /// Requests no longer wait: the session ends.
  void end() { ended_ = true; }

 private:
  std::chrono::milliseconds longest_;
  int responses_;
  std::atomic<bool> ended_{false};
  std::atomic<int> waiting_{0};
};

struct HostOptions {
  HttpOptions http;
  std::string token;  ///< new_token()
  PageFiles files;
  std::string guide;  ///< the page of the documents that describes the places
};

/// A host at `address` and `port`, without one at the usual port or the next that is free, whose page is `index`.html;
/// made before anything that takes time. Throws as listen_on and read_page_files do.
HostOptions host_at(const std::string& address, std::optional<int> port, const std::string& index,
                    const std::string& guide);

/// What the labelling page and the viewer have in common: an address with a secret, and the places below it.
class PageHost : NonCopyable {
 public:
  struct Place {
    const char* method;
    std::function<HttpResponse(const HttpRequest&)> answer;
  };
  /// By their names below the secret folder; one that ends in '/' is of all that lies below it.
  using Places = std::map<std::string, Place>;

  /// Serves the files and `places` when it returns. Throws as listen_on does.
  PageHost(HostOptions options, Places places);

  /// The address to open, with the token.
  std::string url() const;
  int port() const { return options_.http.port; }

 private:
  // None: the request may go on. A wrong token gives 404 without a detail; what follows is for whoever knows the token.
  std::optional<HttpResponse> refuse(const HttpRequest& head) const;
  bool is_token(const std::string& path) const;
  bool is_host(const std::string& host) const;
  HttpResponse route(const HttpRequest& request);

  HostOptions options_;  // its address and port: what the server is bound to
  Places places_;
  std::optional<HttpServer> http_;
};

// The labelling page.

/// Milliseconds since 1970.
std::int64_t now_ms();

struct PageOptions : HostOptions {
  ExportOptions exports{};
  std::uint64_t first_revision = 0;  ///< added to every revision; above all of an earlier server of the run
  std::string run_id{};              ///< kept_run_id()
  int longest_poll_ms = 20000;       ///< how long a request for news waits
};

/// What of the page's state a client has not got yet.
class StateNews {
 public:
  /// All of the state; nothing happens where `revision` is not above the last one.
  void take(Json all, std::uint64_t revision);
  /// The sections that changed after the revision; of views those that did, with their `index` and the keys that
  /// changed; marks from `marks_kept` on, where those before are as they were.
  Json since(std::uint64_t after) const;
  std::uint64_t revision() const { return revision_; }

 private:
  using Stamps = std::map<std::string, std::uint64_t>;  // revision of the last change, by key
  Json all_ = Json::object();
  Stamps sections_;
  std::vector<Stamps> views_;
  std::vector<std::uint64_t> marks_;  // likewise of each, and one more of the list's end
  std::uint64_t revision_ = 0;
};

class PageServer : NonCopyable {
 public:
  /// Serves when it returns; the source must outlive it. Throws as listen_on does.
  PageServer(LabelSource& source, PageOptions options);
  /// Requests that wait for news get a response, pictures are waited for.
  ~PageServer() { end_waiting(); }

  std::string url() const { return host_.url(); }
  int port() const { return host_.port(); }

  /// Requests for news no longer wait: the session ends.
  void end_waiting() { news_.end(); }
  std::vector<ExportState> exports() const { return exports_.list(); }

 private:
  HttpResponse get_state(const HttpRequest& request);
  Json news_since(std::uint64_t after);
  HttpResponse get_photo(const HttpRequest& request) const;
  HttpResponse post_event(const HttpRequest& request);
  HttpResponse post_picture(const HttpRequest& request);
  HttpResponse post_thing(const HttpRequest& request);
  HttpResponse post_export(const HttpRequest& request);
  void check_view(std::uint64_t view) const;
  PageHost::Places places();

  LabelSource& source_;
  PageOptions options_;
  PageExports exports_;
  std::mutex told_mutex_;
  StateNews told_;
  News news_;
  PageHost host_;  // last: it answers by all of these
};

}  // namespace semfield::app
