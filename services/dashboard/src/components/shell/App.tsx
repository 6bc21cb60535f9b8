import { phase } from "../../api/session";
import { Toasts } from "../ui/Toasts";
import { SignIn } from "./SignIn";
import { Unreachable } from "./Unreachable";
import { Workspace } from "./Workspace";

export function App() {
  return (
    <>
      <Page />
      <Toasts />
    </>
  );
}

function Page() {
  switch (phase.value) {
    case "starting":
      return null;
    case "sign-in":
      return <SignIn />;
    case "unreachable":
      return <Unreachable />;
    case "ready":
      return <Workspace />;
  }
}
