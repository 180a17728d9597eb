// The labelling page over HTTP: every address below its secret folder, and what it returns.
#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <string>

#include "app/serve/http_server.h"
#include "app/serve/page_exports.h"
#include "app/serve/page_files.h"
#include "app/serve/page_host.h"
#include "core/non_copyable.h"
#include "labels/serve/label_session.h"

namespace semfield::app {

/// Milliseconds since 1970.
std::int64_t now_ms();

struct PageOptions {
  HttpOptions http;
  bool next_port = false;  ///< when http.port is taken, one of the 99 behind it
  ExportOptions exports;
  std::map<std::string, PageFile> files;
  std::uint64_t first_revision = 0;  ///< added to every revision; above all of an earlier server of the run
  std::string token;                 ///< new_token()
  std::string run_id;                ///< kept_run_id()
  int longest_poll_ms = 20000;       ///< how long a request for news waits
};

class PageServer : NonCopyable {
 public:
  /// Serves when it returns; the source must outlive it. Throws as free_port does.
  PageServer(LabelSource& source, PageOptions options);
  /// Requests that wait for news get a response, pictures are waited for.
  ~PageServer() { end_waiting(); }

  std::string url() const { return host_.url(); }
  int port() const { return host_.port(); }

  /// Requests for news no longer wait: the session ends.
  void end_waiting() { stopping_ = true; }

 private:
  HttpResponse get_state(const HttpRequest& request) const;
  HttpResponse get_photo(const HttpRequest& request) const;
  HttpResponse post_event(const HttpRequest& request);
  HttpResponse post_picture(const HttpRequest& request);
  HttpResponse post_export(const HttpRequest& request);
  void check_view(std::uint64_t view) const;
  PageHost::Places places();

  LabelSource& source_;
  PageOptions options_;
  PageExports exports_;
  std::atomic<bool> stopping_{false};
  mutable std::atomic<int> waiting_for_news_{0};
  PageHost host_;  // last: it answers by all of these
};

}  // namespace semfield::app
