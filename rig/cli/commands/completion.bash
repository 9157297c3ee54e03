_rig() {
    local line end cur=${COMP_WORDS[COMP_CWORD]}
    [[ $cur != [=:] ]] || cur=
    COMPREPLY=()
    while IFS= read -r line; do
        case $line in
        $'\t'*)
            compopt -o filenames -o default
            [[ $cur == [~\"\'\$]* ]] || while IFS= read -r end; do COMPREPLY+=("$end"); done < <(
                compgen -d -- "$cur"
                for end in ${line}; do [[ $end == / ]] || compgen -f -X "!*$end" -- "$cur"; done
            ) ;;
        *) COMPREPLY+=("${line%%$'\t'*}") ;;
        esac
    done < <("${1/#\~/$HOME}" __complete bash "${COMP_LINE:0:COMP_POINT}" 2>/dev/null)
    [[ ${COMPREPLY[0]} != *= ]] || compopt -o nospace
}
complete -F _rig rig
