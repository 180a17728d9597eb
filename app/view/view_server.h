// The page of `semfield view` over HTTP: every address below the secret folder, and what it returns.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "app/serve/http_server.h"
#include "app/serve/page_exports.h"
#include "app/serve/page_server.h"
#include "app/view/viewed_run.h"

namespace semfield::app {

struct ViewOptions {
  HttpOptions http;
  bool next_port = false;  ///< when http.port is taken, one of the 99 behind it
  ExportOptions films;     ///< of the first run
  std::string page;        ///< live_page_text()
};

class ViewServer final : private HttpHandler {
 public:
  /// Serves when it returns; `runs`, one or two, must outlive it. Throws as free_port does.
  ViewServer(std::vector<ViewedRun*> runs, ViewOptions options);
  ~ViewServer() override;
  ViewServer(const ViewServer&) = delete;
  ViewServer& operator=(const ViewServer&) = delete;

  /// The address to open.
  std::string url() const { return access_->url(); }

 private:
  std::optional<HttpResponse> refuse(const HttpRequest& head) noexcept override;
  HttpResponse answer(const HttpRequest& request) noexcept override;

  HttpResponse route(const std::string& name, const HttpRequest& request);
  HttpResponse get_page(const HttpRequest& request);
  HttpResponse get_surface(const HttpRequest& request);
  HttpResponse get_probability(const HttpRequest& request);
  HttpResponse get_state(const HttpRequest& request);
  HttpResponse post_picture(const HttpRequest& request);
  HttpResponse post_point(const HttpRequest& request);
  HttpResponse post_edit(const HttpRequest& request);
  HttpResponse post_film(const HttpRequest& request);
  ViewedRun& run(std::uint64_t number) const;

  std::vector<ViewedRun*> runs_;
  ViewOptions options_;
  PageExports films_;
  std::unique_ptr<PageAccess> access_;
  std::unique_ptr<HttpServer> http_;
};

}  // namespace semfield::app
