// An address with a secret, the places below it, and what is answered there.
#pragma once

#include <functional>
#include <map>
#include <optional>
#include <string>

#include "app/json_output.h"
#include "app/serve/http_server.h"
#include "core/error.h"
#include "core/non_copyable.h"

namespace semfield::app {

/// {"error", "code", "remedy"}.
std::string error_json(Code code, const std::string& message, const std::string& remedy);
/// Texts of files and folders may be no UTF-8; numbers that are none become null.
HttpResponse json_answer(const Json& json);
/// What `answer` returns, or what it throws as such a response: what the client did wrong is 400; what could not be
/// kept or made now is 503.
HttpResponse safe_answer(const std::function<HttpResponse()>& answer) noexcept;
/// 405 at an address that takes another method.
HttpResponse wrong_method(const char* allowed);

/// What the labelling page and the viewer have in common: an address with a secret, and the places below it.
class PageHost : NonCopyable {
 public:
  struct Place {
    const char* method;
    std::function<HttpResponse(const HttpRequest&)> answer;
  };
  /// By their names below the secret folder; one that ends in '/' is of all that lies below it.
  using Places = std::map<std::string, Place>;

  /// Serves `places`, which `guide` describes, when it returns; `next_port`: when the port is taken, one of the 99
  /// behind it. Throws as free_port does.
  PageHost(std::string token, HttpOptions http, bool next_port, std::string guide, Places places);

  /// The address to open, with the token.
  std::string url() const;
  int port() const { return port_; }

 private:
  // None: the request may go on. A wrong token gives 404 without a detail; what follows is for whoever knows the token.
  std::optional<HttpResponse> refuse(const HttpRequest& head) const;
  bool is_token(const std::string& path) const;
  bool is_host(const std::string& host) const;
  HttpResponse route(const HttpRequest& request);

  std::string guide_, token_, address_;  // address and port: what the server is bound to
  int port_ = 0;
  Places places_;
  std::optional<HttpServer> http_;
};

}  // namespace semfield::app
