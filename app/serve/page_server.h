// The page over HTTP: every address below the secret folder, and what it returns.
#pragma once

#include <atomic>
#include <map>
#include <memory>
#include <string>

#include "app/serve/http_server.h"
#include "app/serve/page_access.h"
#include "app/serve/page_exports.h"
#include "app/serve/page_files.h"
#include "app/serve/page_source.h"

namespace semfield::app {

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

class PageServer final : private HttpHandler {
 public:
  /// Serves when it returns; the source must outlive it. Throws as free_port does.
  PageServer(PageSource& source, PageOptions options);
  /// Requests that wait for news get a response, pictures are waited for.
  ~PageServer() override;
  PageServer(const PageServer&) = delete;
  PageServer& operator=(const PageServer&) = delete;

  /// Requests for news no longer wait: the session ends.
  void end_waiting() { stopping_ = true; }
  /// The address to open.
  std::string url() const { return access_->url(); }
  int port() const { return access_->port(); }

 private:
  std::optional<HttpResponse> refuse(const HttpRequest& head) noexcept override;
  HttpResponse answer(const HttpRequest& request) noexcept override;

  HttpResponse route(const std::string& name, const HttpRequest& request);
  HttpResponse get_state(const HttpRequest& request) const;
  HttpResponse get_photo(const HttpRequest& request) const;
  HttpResponse get_camera(const HttpRequest& request) const;
  HttpResponse post_event(const HttpRequest& request);
  HttpResponse post_picture(const HttpRequest& request);
  HttpResponse post_export(const HttpRequest& request);
  int view_of(const HttpRequest& request) const;
  void check_view(std::uint64_t view) const;

  PageSource& source_;
  PageOptions options_;
  PageExports exports_;
  std::atomic<bool> stopping_{false};
  mutable std::atomic<int> waiting_for_news_{0};
  std::unique_ptr<PageAccess> access_;
  std::unique_ptr<HttpServer> http_;
};

}  // namespace semfield::app
